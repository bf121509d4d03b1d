// Canvas, camera and when to draw: only what has changed is drawn again.
import { THREE, OrbitControls } from "./three.js";

const CENTRE = new THREE.Vector3(0, -0.025, -0.03); // metres: the middle of a face and its hair
const FOV = 24, DISTANCE = 0.76;
const NEAR = 4000; // pixels a metre of the picture from which more texels than the first albedo's are seen
const QUICK = 34, TOO_LONG = 110, RESTED = 400; // milliseconds from picture to picture

export class Stage {
  // box: the element that the canvas fills; surface: whose key light throws the shadow
  constructor(canvas, context, box) {
    this.box = box;
    this.context = context;
    const renderer = new THREE.WebGLRenderer({ canvas, context, antialias: true });
    renderer.toneMapping = THREE.NeutralToneMapping;
    renderer.shadowMap.enabled = true;
    renderer.shadowMap.type = THREE.PCFShadowMap;
    renderer.shadowMap.autoUpdate = false;
    this.renderer = renderer;
    this.scene = new THREE.Scene();
    this.scene.background = backdrop();
    this.camera = new THREE.PerspectiveCamera(FOV, 1, 0.02, 20);
    this.controls = new OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { minDistance: 0.12, maxDistance: 3, zoomSpeed: 0.8, rotateSpeed: 0.9 });
    this.controls.addEventListener("change", () => this.redraw());
    this.controls.addEventListener("start", () => this.leaveFilm());
    this.moved = null; // called before every picture
    this.near = null; // called once, when the face is seen from near
    this.running = this.whole = false; // whole: the avatar is shown, and not the first picture alone
    this.film = null; // the lens that is looked through: { size: [w, h], focal } in pixels
    this.dirty = this.shadowStale = true;
    this.steady = false; // while a clip is recorded its size must not change
    this.centre = CENTRE.clone();
    new ResizeObserver(() => this.resize()).observe(box);
  }

  // whose details are to be refreshed, whose key light throws the shadow, once it is shown
  take(avatar, surface) {
    this.avatar = avatar;
    this.surface = surface;
    this.scene.add(surface.key, surface.key.target);
  }

  // shows the avatar when its shaders are compiled; before: what was seen until then, or null
  async show(before) {
    const { renderer, scene, avatar } = this;
    if (renderer.extensions.has("KHR_parallel_shader_compile")) await renderer.compileAsync(avatar.root, this.camera, scene);
    scene.add(avatar.root);
    if (before) scene.remove(before);
    this.whole = true;
    this.resize(); // the time line has taken its place: drawn once, and not again when the observer tells
    this.redraw(true);
  }

  redraw(shadow = false) {
    this.dirty = true;
    this.shadowStale ||= shadow;
  }

  // the face from the front
  frame() {
    this.film = null;
    this.camera.position.copy(CENTRE).add(new THREE.Vector3(0, 0, DISTANCE));
    this.controls.target.copy(CENTRE);
    this.resize(true);
    this.controls.update();
  }

  // through a film's lens: place is the camera's matrix in the scene
  lookThrough(place, size, focal) {
    this.film = { size, focal };
    place.decompose(this.camera.position, this.camera.quaternion, new THREE.Vector3());
    this.resize(true);
  }

  // whoever drags leaves the film's place and goes on from there
  leaveFilm() {
    if (!this.film) return;
    this.film = null;
    const { camera } = this, ahead = new THREE.Vector3(0, 0, -1).applyQuaternion(camera.quaternion);
    const far = Math.max(CENTRE.clone().sub(camera.position).dot(ahead), 0.2);
    this.controls.target.copy(camera.position).addScaledVector(ahead, far);
    this.controls.update();
  }

  resize(force = false) {
    const { clientWidth: w, clientHeight: h } = this.box, { renderer, camera } = this;
    if (!w || !h) return;
    const ratio = Math.min(devicePixelRatio || 1, 2), size = renderer.getSize(new THREE.Vector2());
    if (!force && size.x === w && size.y === h) return;
    renderer.setPixelRatio(ratio);
    renderer.setSize(w, h, false);
    camera.aspect = w / h;
    let tangent = Math.tan(THREE.MathUtils.degToRad(FOV / 2)) * Math.max(1, 0.8 * h / w); // narrow: the head's width fits
    if (this.film) {
      const [filmed, high] = this.film.size;
      tangent = Math.max(high, filmed * h / w) / 2 / this.film.focal;
    }
    camera.fov = THREE.MathUtils.radToDeg(2 * Math.atan(tangent));
    camera.updateProjectionMatrix();
    this.redraw();
  }

  // whole: the shadow too, whatever has changed; scale: of the picture's sides
  draw(whole = false, scale = 1) {
    const { renderer, surface } = this, { clientWidth: w, clientHeight: h } = this.box;
    const ratio = scale * Math.min(devicePixelRatio || 1, 2);
    if (ratio !== renderer.getPixelRatio() && w && h) {
      renderer.setPixelRatio(ratio);
      renderer.setSize(w, h, false);
    }
    if (this.near && this.whole && this.pixels() > NEAR) {
      this.near();
      this.near = null;
    }
    if (this.whole) this.avatar.details?.refresh();
    renderer.shadowMap.needsUpdate = this.whole && surface.key.castShadow && (whole || this.shadowStale);
    this.dirty = this.shadowStale = false;
    renderer.render(this.scene, this.camera);
  }

  // Calls `moved` before every picture and draws where there is something new. Where pictures take long they are drawn
  // coarser while things move, and finely once they rest.
  run() {
    if (this.running) return;
    this.running = true;
    let last = 0, slow = 0, owed = false;
    const step = (now) => {
      this.moved?.();
      if (this.dirty) {
        const gap = now - last;
        slow = gap < TOO_LONG || gap > RESTED ? Math.max(slow - (gap < QUICK ? 1 : 0), 0) : Math.min(slow + 1, 3);
        const coarse = slow >= 2 && !this.steady;
        this.draw(false, coarse ? 0.5 : 1);
        last = now;
        owed = coarse;
      } else if (owed && now - last > RESTED) {
        this.draw();
        owed = false;
      }
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  // of the window, a metre of the face
  pixels() {
    const { camera, renderer } = this, far = camera.position.distanceTo(this.centre);
    return renderer.domElement.height / (2 * far * Math.tan(THREE.MathUtils.degToRad(camera.fov / 2)));
  }

  // until a picture that has been asked for is on the screen
  painted() {
    return new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done))));
  }

  // until what was drawn is there
  wait() {
    const { context } = this;
    context.readPixels(0, 0, 1, 1, context.RGBA, context.UNSIGNED_BYTE, new Uint8Array(4));
  }

  // milliseconds of `count` pictures drawn to the end, and of the CPU's share of them; pose(i) sets an expression
  measure(count, pose) {
    const cpu = [], drawn = [];
    for (let i = 0; i < count; i++) {
      const since = performance.now();
      pose(i);
      cpu.push(performance.now() - since);
      this.draw(true);
      this.wait();
      drawn.push(performance.now() - since);
    }
    return { cpu, drawn };
  }
}

function backdrop() {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 256;
  const context = canvas.getContext("2d");
  const light = context.createRadialGradient(128, 108, 10, 128, 128, 190);
  light.addColorStop(0, "#3a3e45");
  light.addColorStop(0.55, "#24272c");
  light.addColorStop(1, "#131417");
  context.fillStyle = light;
  context.fillRect(0, 0, 256, 256);
  const texture = new THREE.CanvasTexture(canvas);
  texture.colorSpace = THREE.SRGBColorSpace;
  return texture;
}
