// Surroundings that light the head, as formulas: a gradient and a few soft lamps. No picture is loaded.
//
// A lamp is a spherical Gaussian: light(d) = radiance exp(sharpness (axis . d - 1)). What falls on a diffuse surface is
// y^T phi(n), equation (1) of the paper: nine numbers a colour, fitted here once for each of the surroundings.

const unit = (v) => {
  const length = Math.hypot(...v);
  return v.map((x) => x / length);
};
const lamp = (axis, radiance, sharpness) => ({ axis: unit(axis), radiance, sharpness });

// above, ahead, below: radiance of the gradient; key: the one lamp with a shadow, which can be moved
export const ENVIRONMENTS = {
  studio: {
    title: "Studio",
    sky: [[0.42, 0.43, 0.46], [0.26, 0.26, 0.27], [0.13, 0.12, 0.115]],
    lamps: [
      lamp([-0.9, 0.45, 0.75], [3.2, 3.1, 3.0], 9),
      lamp([1.0, 0.25, 0.35], [1.5, 1.6, 1.8], 12),
      lamp([0.15, 1.0, -0.5], [2.2, 2.2, 2.3], 10),
    ],
    key: { direction: [-0.55, 0.6, 0.75], light: 0.42 },
  },
  soft: {
    title: "Overcast",
    sky: [[0.95, 1.0, 1.08], [0.62, 0.64, 0.67], [0.24, 0.23, 0.21]],
    lamps: [lamp([0.1, 1.0, 0.35], [0.9, 0.9, 0.92], 3)],
    key: { direction: [0.2, 0.85, 0.5], light: 0.1 },
  },
  window: {
    title: "Window",
    sky: [[0.16, 0.17, 0.19], [0.14, 0.14, 0.145], [0.09, 0.08, 0.07]],
    lamps: [lamp([1.0, 0.25, 0.45], [6.0, 6.3, 6.8], 9), lamp([-0.9, 0.2, 0.3], [0.55, 0.5, 0.42], 5)],
    key: { direction: [0.85, 0.35, 0.5], light: 0.5 },
  },
  rim: {
    title: "Rim light",
    sky: [[0.1, 0.1, 0.12], [0.07, 0.07, 0.08], [0.05, 0.05, 0.05]],
    lamps: [
      lamp([1.0, 0.4, -0.7], [7.0, 6.4, 5.6], 14),
      lamp([-1.0, 0.35, -0.6], [4.0, 4.8, 6.4], 14),
      lamp([-0.3, 0.4, 0.9], [0.9, 0.9, 0.9], 6),
    ],
    key: { direction: [-0.4, 0.5, 0.8], light: 0.22 },
  },
  sunset: {
    title: "Sunset",
    sky: [[0.34, 0.42, 0.62], [0.42, 0.33, 0.28], [0.13, 0.1, 0.09]],
    lamps: [lamp([-1.0, 0.12, 0.35], [7.5, 3.9, 1.8], 12)],
    key: { direction: [-0.85, 0.25, 0.5], light: 0.55, colour: [1.0, 0.72, 0.5] },
  },
};

const basis = ([a, b, c]) => [1, a, b, c, a * b, a * c, b * c, a * a - b * b, 3 * c * c - 1];

// directions evenly over the sphere
function sphere(count) {
  const out = [];
  for (let i = 0; i < count; i++) {
    const y = 1 - (2 * i + 1) / count, r = Math.sqrt(1 - y * y), angle = i * 2.399963229728653;
    out.push([r * Math.cos(angle), y, r * Math.sin(angle)]);
  }
  return out;
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const mix = (a, b, t) => a.map((x, i) => x + (b[i] - x) * t);

function radiance(environment, d) {
  const [above, ahead, below] = environment.sky;
  let light = d[1] > 0 ? mix(ahead, above, d[1]) : mix(ahead, below, Math.min(1, -d[1] / 0.7));
  for (const { axis, radiance, sharpness } of environment.lamps) {
    const share = Math.exp(sharpness * (dot(axis, d) - 1));
    light = light.map((x, i) => x + radiance[i] * share);
  }
  return light;
}

// y (9, 3) with y^T phi(n) = (1 / pi) integral of light(d) max(n . d, 0)
export function harmonics(environment) {
  const directions = sphere(800), lights = directions.map((d) => radiance(environment, d));
  const normals = sphere(120);
  const normal = Array.from({ length: 9 }, () => new Float64Array(9)), right = Array.from({ length: 9 }, () => [0, 0, 0]);
  for (const n of normals) {
    const fallen = [0, 0, 0];
    directions.forEach((d, i) => {
      const cosine = Math.max(dot(n, d), 0) * 4 / directions.length;
      for (let c = 0; c < 3; c++) fallen[c] += cosine * lights[i][c];
    });
    const phi = basis(n);
    for (let j = 0; j < 9; j++) {
      for (let k = 0; k < 9; k++) normal[j][k] += phi[j] * phi[k];
      for (let c = 0; c < 3; c++) right[j][c] += phi[j] * fallen[c];
    }
  }
  return solve(normal, right);
}

// Gaussian elimination; the matrix is symmetric and far from singular
function solve(matrix, right) {
  const n = matrix.length;
  for (let i = 0; i < n; i++)
    for (let row = i + 1; row < n; row++) {
      const factor = matrix[row][i] / matrix[i][i];
      for (let k = i; k < n; k++) matrix[row][k] -= factor * matrix[i][k];
      right[row] = right[row].map((x, c) => x - factor * right[i][c]);
    }
  for (let i = n - 1; i >= 0; i--) {
    for (let k = i + 1; k < n; k++) right[i] = right[i].map((x, c) => x - matrix[i][k] * right[k][c]);
    right[i] = right[i].map((x) => x / matrix[i][i]);
  }
  return right;
}

// The light of the photos: its harmonics are given; what is mirrored is guessed from them.
export function ofPhotos(y) {
  const front = (y[0][0] + y[0][1] + y[0][2] + y[3][0] + y[3][1] + y[3][2] + 2 * (y[8][0] + y[8][1] + y[8][2])) / 3;
  const scale = 0.78 / Math.max(front, 1e-6);
  const scaled = y.map((row) => row.map((x) => x * scale));
  const at = (d) => basis(d).reduce((sum, phi, j) => sum.map((x, c) => x + phi * scaled[j][c]), [0, 0, 0]);
  const held = (light) => light.map((x) => Math.max(x, 0.04));
  const main = [1, 2, 3].map((j) => (scaled[j][0] + scaled[j][1] + scaled[j][2]) / 3);
  const strength = Math.hypot(...main);
  const axis = strength > 1e-3 ? unit(main) : [0, 0, 1];
  const lamps = [lamp(axis, at(axis).map((x) => Math.max(1.6 * x, 0)), 14)];
  return {
    title: "As photographed",
    sky: [held(at([0, 1, 0])), held(at([0, 0, 1])).map((x) => 0.7 * x), held(at([0, -1, 0]))],
    lamps,
    key: { direction: axis, light: 0 },
    harmonics: scaled,
  };
}
