// Details of the current expression: files of avatar/details -> textures and uniforms of synthesis.glsl.
import { THREE } from "./three.js";

const SLOT = 0; // the one uniform block of the page; an unbound program's blocks read from slot 0

async function picture(address) {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error(`${address}: ${answer.status}`);
  // bytes as they are: no colour space, no alpha, no flip
  return createImageBitmap(await answer.blob(), { colorSpaceConversion: "none", premultiplyAlpha: "none" });
}

export async function loadDetails(folder, renderer) {
  const answer = await fetch(`${folder}/details.json`);
  if (!answer.ok) throw new Error(`details.json: ${answer.status}`);
  const about = await answer.json();
  if (about.version !== 1) throw new Error(`details.json has version ${about.version}, 1 is needed`);
  const [positions, ...weights] = await Promise.all(
    [about.positions.file, ...about.weights.map((row) => row.file)].map((name) => picture(`${folder}/${name}`)),
  );
  return new Details(about, positions, weights, renderer);
}

class Details {
  constructor(about, positions, weights, renderer) {
    this.about = about;
    this.keyframes = about.keyframes.length;
    this.edges = about.edges.length;
    this.gl = renderer.getContext();
    this.defines = { KEYFRAMES: this.keyframes, EDGES: this.edges };
    const at = (values) => values.map((v) => new THREE.Vector3(...v));
    this.uniforms = {
      detail_positions: { value: positionTexture(positions) },
      detail_weights: { value: weightTexture(weights, about.side) },
      detail_low: { value: at(about.positions.low_mm) },
      detail_step: { value: at(about.positions.step_mm) },
      detail_beta: { value: about.beta_per_mm },
      detail_scale: { value: at(about.weights.map((row) => row.scale)) },
      detail_centre: { value: about.keyframes.map((key) => key.centre) },
    };
    this.block = new Float32Array(8 * this.keyframes * this.edges);
    about.keyframes.forEach((key, k) => key.ends_mm.forEach((ends, e) => {
      const length = Math.hypot(ends[0] - ends[3], ends[1] - ends[4], ends[2] - ends[5]);
      this.block.set([...ends.slice(0, 3), length], 4 * (k * this.edges + e));
      this.block.set(ends.slice(3), 4 * (this.keyframes * this.edges + k * this.edges + e));
    }));
    const { gl } = this;
    this.buffer = gl.createBuffer();
    gl.bindBuffer(gl.UNIFORM_BUFFER, this.buffer);
    gl.bufferData(gl.UNIFORM_BUFFER, this.block, gl.DYNAMIC_DRAW);
    gl.bindBuffer(gl.UNIFORM_BUFFER, null);
    gl.bindBufferBase(gl.UNIFORM_BUFFER, SLOT, this.buffer);
    this.setStrain(new Float64Array(this.edges));
  }

  // strain: of every edge; ((f_e - f_ke) / spread_e)^2 of every keyframe is all that an expression changes
  setStrain(strain) {
    const { about, block, gl } = this;
    const first = 4 * this.keyframes * this.edges;
    for (let e = 0; e < this.edges; e++) {
      const held = Math.min(Math.max(strain[e], about.strain_low[e]), about.strain_high[e]);
      for (let k = 0; k < this.keyframes; k++) {
        const d = (held - about.keyframes[k].strain[e]) / about.strain_spread[e];
        block[first + 4 * (k * this.edges + e) + 3] = d * d;
      }
    }
    gl.bindBuffer(gl.UNIFORM_BUFFER, this.buffer);
    gl.bufferSubData(gl.UNIFORM_BUFFER, 0, block);
    gl.bindBuffer(gl.UNIFORM_BUFFER, null);
  }
}

function positionTexture(image) {
  const texture = new THREE.Texture(image);
  texture.colorSpace = THREE.NoColorSpace;
  texture.flipY = false;
  texture.premultiplyAlpha = false;
  texture.generateMipmaps = false;
  texture.minFilter = texture.magFilter = THREE.NearestFilter;
  texture.needsUpdate = true;
  return texture;
}

function weightTexture(images, side) {
  const data = new Uint8Array(4 * side * side * images.length);
  const canvas = new OffscreenCanvas(side, side);
  const context = canvas.getContext("2d", { willReadFrequently: true, colorSpace: "srgb" });
  images.forEach((image, j) => {
    context.drawImage(image, 0, 0); // opaque pictures: the canvas gives their bytes back unchanged
    data.set(context.getImageData(0, 0, side, side).data, 4 * side * side * j);
  });
  const texture = new THREE.DataArrayTexture(data, side, side, images.length);
  texture.colorSpace = THREE.NoColorSpace;
  texture.minFilter = THREE.LinearMipmapLinearFilter;
  texture.magFilter = THREE.LinearFilter;
  texture.generateMipmaps = true;
  texture.needsUpdate = true;
  return texture;
}
