// The light: its direction, on a ball to drag on, and its surroundings. Directions: x right, y up, z near.
import { THREE } from "./three.js";
import { ENVIRONMENTS, harmonics, ofPhotos } from "./environment.js";

function lightPad(canvas, changed) {
  const context = canvas.getContext("2d");
  const direction = [-0.5, 0.5, 0.7];

  function draw() {
    const { width, height } = canvas, r = width / 2;
    const image = context.createImageData(width, height);
    for (let row = 0; row < height; row++)
      for (let column = 0; column < width; column++) {
        const x = (column + 0.5 - r) / (r - 1), y = -(row + 0.5 - r) / (r - 1), square = x * x + y * y;
        const at = 4 * (row * width + column);
        if (square > 1) continue;
        const z = Math.sqrt(1 - square);
        const lit = Math.max(x * direction[0] + y * direction[1] + z * direction[2], 0);
        const value = 255 * Math.pow(0.035 + 0.5 * lit, 1 / 2.2);
        image.data.set([value * 0.96, value * 0.98, value * 1.02, 255 * Math.min(1, (1 - square) * r * 0.6)], at);
      }
    context.putImageData(image, 0, 0);
    context.beginPath();
    context.arc(r + direction[0] * (r - 10), r - direction[1] * (r - 10), 5, 0, 7);
    context.fillStyle = direction[2] >= 0 ? "#fff" : "#fff8";
    context.fill();
    context.lineWidth = 2;
    context.strokeStyle = "#0009";
    context.stroke();
  }

  function set(d, tell = true) {
    const length = Math.hypot(...d) || 1;
    d.forEach((x, i) => { direction[i] = x / length; });
    draw();
    if (tell) changed(direction);
  }

  // inside the ball's inner disc the light is before the head, outside behind it
  function point(event) {
    const box = canvas.getBoundingClientRect();
    let x = 2 * (event.clientX - box.left) / box.width - 1, y = 1 - 2 * (event.clientY - box.top) / box.height;
    const r = Math.hypot(x, y), over = Math.max(r - 0.88, 0) / 0.5;
    const length = Math.min(r / 0.88, 1);
    if (r > 1e-6) { x *= length / r; y *= length / r; }
    const z = Math.sqrt(Math.max(1 - x * x - y * y, 0));
    set([x, y, over > 0 ? -Math.min(over, 1) * 0.9 : z]);
  }

  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); point(event); });
  canvas.addEventListener("pointermove", (event) => { if (canvas.hasPointerCapture(event.pointerId)) point(event); });
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-0.12, 0], ArrowRight: [0.12, 0], ArrowUp: [0, 0.12], ArrowDown: [0, -0.12] }[event.key];
    if (!step) return;
    event.preventDefault();
    event.stopPropagation();
    set([direction[0] + step[0], direction[1] + step[1], direction[2]]);
  });
  draw();
  return { set, get direction() { return direction; } };
}

// The fields of the section Light, tied to the surface. photos: (9, 3) light of the photos, or null.
export function lighting(place, surface, stage, photos) {
  const environments = { ...(photos ? { photos: ofPhotos(photos) } : {}), ...ENVIRONMENTS };
  const { environment, turn, ambient, key } = place;
  for (const [name, { title }] of Object.entries(environments)) environment.add(new Option(title, name));
  const pad = lightPad(place.pad, () => relight());

  function relight() {
    for (const input of [turn, ambient, key])
      input.style.setProperty("--at", `${100 * (input.value - input.min) / (input.max - input.min)}%`);
    const chosen = environments[environment.value];
    chosen.harmonics ??= harmonics(chosen);
    surface.setSurroundings(chosen, chosen.harmonics, Number(ambient.value));
    surface.turnSurroundings(THREE.MathUtils.degToRad(Number(turn.value)));
    const light = new THREE.Vector3(...(chosen.key.colour ?? [1, 1, 1])).multiplyScalar(Number(key.value));
    surface.setKey(new THREE.Vector3(...pad.direction), light, stage.avatar.head.position.clone().add(stage.centre));
    surface.key.castShadow = light.length() > 0;
    stage.redraw(true);
  }

  function use(name) {
    environment.value = name;
    key.value = environments[name].key.light;
    pad.set(environments[name].key.direction, false);
    relight();
  }
  environment.addEventListener("change", () => use(environment.value));
  for (const input of [turn, ambient, key]) input.addEventListener("input", relight);
  return { use, relight, set: pad.set };
}
