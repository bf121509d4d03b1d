// The viewer: loads what the program has prepared, draws when something has changed, and ties the controls to it.
// window.viewer is the same from a script (docs/viewer.md).
import { THREE, OrbitControls } from "./three.js";
import { Avatar, loadGlb } from "./avatar.js";
import { loadDetails } from "./details.js";
import { ENVIRONMENTS, harmonics, ofPhotos } from "./environment.js";
import { lightPad } from "./light.js";
import { Live } from "./live.js";
import { slidersIn, togglesIn } from "./panel.js";
import { picture, Recorder, save } from "./record.js";
import { PRESETS, readTable, weightsOf } from "./shapes.js";
import { Surface } from "./surface.js";
import { Performance, Timeline } from "./timeline.js";

const $ = (id) => document.getElementById(id);
const CENTRE = new THREE.Vector3(0, -0.025, -0.03); // metres: the middle of a face and its hair
const FOV = 24, DISTANCE = 0.76;

function stop(text) {
  $("cover").classList.remove("gone");
  $("cover").classList.add("fault");
  $("cover-text").textContent = text;
  document.documentElement.dataset.state = "fault";
}

const toast = (() => {
  let timer = 0;
  return (text, seconds = 4) => {
    $("toast").textContent = text;
    $("toast").hidden = false;
    clearTimeout(timer);
    timer = setTimeout(() => { $("toast").hidden = true; }, 1000 * seconds);
  };
})();

async function fetched(address, kind) {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error((await answer.text()) || `${address}: ${answer.status}`);
  return answer[kind]();
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

async function main() {
  const canvas = $("canvas");
  const context = canvas.getContext("webgl2", { antialias: true, alpha: false, powerPreference: "high-performance" });
  if (!context) return stop("This page draws with WebGL 2, which this browser does not offer. Try a current Firefox, Chrome, Edge or Safari, and see that hardware acceleration is on.");
  canvas.addEventListener("webglcontextlost", () => stop("The graphics card gave up (its context was lost). Load the page again."));

  const [about, gltf, vertex, fragment, synthesis] = await Promise.all([
    fetched("data/scene.json", "json"),
    loadGlb("data/avatar.glb"),
    ...["surface.vert.glsl", "surface.frag.glsl", "synthesis.glsl"].map((name) => fetched(name, "text")),
  ]);
  if (about.version !== 1) throw new Error(`scene.json has version ${about.version}, 1 is needed`);
  const missing = { ...about.missing };
  document.title = `${about.title} – avatar`;
  $("name").textContent = about.title;

  const renderer = new THREE.WebGLRenderer({ canvas, context, antialias: true });
  renderer.toneMapping = THREE.NeutralToneMapping;
  renderer.shadowMap.enabled = true;
  renderer.shadowMap.type = THREE.PCFShadowMap;
  renderer.shadowMap.autoUpdate = false;
  renderer.info.autoReset = false;

  let details = null;
  const [read, traits] = await Promise.allSettled([
    about.details ? loadDetails("data/details", renderer, synthesis) : Promise.resolve(null),
    fetched("data/traits.bin", "arrayBuffer"),
  ]);
  if (read.status === "fulfilled") details = read.value;
  else missing.details = `The details cannot be read (${read.reason.message}).`;

  const surface = new Surface({ vertex, fragment, synthesis }, details);
  gltf.scene.traverse((node) => {
    if (node.name !== "head" || !node.isMesh || traits.status !== "fulfilled") return;
    const { geometry } = node;
    if (traits.value.byteLength === 4 * geometry.attributes.position.count)
      geometry.setAttribute("traits", new THREE.BufferAttribute(new Uint8Array(traits.value), 4, true));
  });
  const avatar = new Avatar(gltf, about, surface, details);
  const scene = new THREE.Scene();
  scene.background = backdrop();
  scene.add(avatar.root, surface.key, surface.key.target);

  const camera = new THREE.PerspectiveCamera(FOV, 1, 0.02, 20);
  const controls = new OrbitControls(camera, canvas);
  Object.assign(controls, { minDistance: 0.12, maxDistance: 3, enableDamping: false, zoomSpeed: 0.8, rotateSpeed: 0.9 });

  let dirty = true, shadowStale = true, filming = false;
  const redraw = (shadow = false) => { dirty = true; shadowStale ||= shadow; };
  controls.addEventListener("change", () => redraw());
  controls.addEventListener("start", () => { if (filming) leaveFilm(); });

  function frame() {
    filming = false;
    camera.matrixAutoUpdate = true;
    controls.enabled = true;
    camera.fov = FOV;
    camera.position.copy(CENTRE).add(new THREE.Vector3(0, 0, DISTANCE));
    controls.target.copy(CENTRE);
    resize(true);
    controls.update();
  }

  // the video's own camera, so that both pictures show the same
  function film() {
    const { performance } = timeline;
    if (!performance?.camera) return;
    filming = true;
    performance.camera.decompose(camera.position, camera.quaternion, new THREE.Vector3());
    resize(true);
  }

  function leaveFilm() {
    filming = false;
    // the point before the camera nearest to the head becomes what is orbited
    const ahead = new THREE.Vector3(0, 0, -1).applyQuaternion(camera.quaternion);
    controls.target.copy(camera.position).addScaledVector(ahead, Math.max(CENTRE.clone().sub(camera.position).dot(ahead), 0.2));
    controls.update();
  }

  function resize(force = false) {
    const { clientWidth: w, clientHeight: h } = $("view");
    if (!w || !h) return;
    const ratio = Math.min(devicePixelRatio || 1, 2), size = renderer.getSize(new THREE.Vector2());
    if (!force && size.x === w && size.y === h && renderer.getPixelRatio() === ratio) return;
    renderer.setPixelRatio(ratio);
    renderer.setSize(w, h, false);
    camera.aspect = w / h;
    if (filming) {
      const [vw, vh] = timeline.performance.size;
      camera.fov = THREE.MathUtils.radToDeg(2 * Math.atan(Math.max(vh, vw * h / w) / 2 / timeline.performance.focal));
    } else {
      // a narrow window keeps the width of the head in view
      camera.fov = THREE.MathUtils.radToDeg(2 * Math.atan(Math.tan(THREE.MathUtils.degToRad(FOV / 2)) * Math.max(1, 0.8 * h / w)));
    }
    camera.updateProjectionMatrix();
    redraw();
  }
  new ResizeObserver(() => resize()).observe($("view"));

  // ---- light
  const environments = { ...(about.light ? { photos: ofPhotos(about.light) } : {}), ...ENVIRONMENTS };
  for (const [key, { title }] of Object.entries(environments)) $("environment").add(new Option(title, key));
  const fields = { turn: $("turn"), ambient: $("ambient"), key: $("key") };
  const pad = lightPad($("pad"), () => relight());
  const filled = (input) => input.style.setProperty("--at", `${100 * (input.value - input.min) / (input.max - input.min)}%`);
  function relight() {
    Object.values(fields).forEach(filled);
    const environment = environments[$("environment").value];
    environment.harmonics ??= harmonics(environment);
    surface.setSurroundings(environment, environment.harmonics, Number(fields.ambient.value));
    surface.turnSurroundings(THREE.MathUtils.degToRad(Number(fields.turn.value)));
    const light = new THREE.Vector3(...(environment.key.colour ?? [1, 1, 1])).multiplyScalar(Number(fields.key.value));
    surface.setKey(new THREE.Vector3(...pad.direction), light, avatar.head.position.clone().add(CENTRE));
    surface.key.castShadow = light.length() > 0;
    redraw(true);
  }
  function useEnvironment(name) {
    $("environment").value = name;
    fields.key.value = environments[name].key.light;
    pad.set(environments[name].key.direction, false);
    relight();
  }
  $("environment").addEventListener("change", () => useEnvironment($("environment").value));
  Object.values(fields).forEach((input) => input.addEventListener("input", relight));

  // ---- what is shown
  const uniforms = surface.shared;
  const shown = {
    albedo: (on) => { uniforms.show_albedo.value = on; },
    details: (on) => { uniforms.show_details.value = on; },
    relief: (on) => { uniforms.show_relief.value = on; },
    occlusion: (on) => { uniforms.show_occlusion.value = on; },
    scatter: (on) => { uniforms.show_skin_light.value = on; },
    wireframe: (on) => avatar.showWires(on),
    normals: (on) => { uniforms.show_normals.value = on; },
    bare: (on) => {
      if (on) kept = ["albedo", "details", "relief", "occlusion"].filter((key) => toggles.on(key));
      for (const key of ["albedo", "details", "relief", "occlusion"]) if (!on === kept.includes(key) || on) toggles.set(key, !on);
    },
  };
  let kept = [];
  const toggles = togglesIn($("toggles"), [
    { key: "albedo", title: "Albedo", hint: "The skin's colour (A)", on: true },
    { key: "details", title: "Details", hint: missing.details ?? "Wrinkles that follow the expression (D)", on: Boolean(details), disabled: !details },
    { key: "relief", title: "Relief", hint: "The normal map of the face at rest (E)", on: true },
    { key: "occlusion", title: "Occlusion", hint: "Hollows get less light (O)", on: true },
    { key: "scatter", title: "Skin light", hint: "Light that scatters below the skin (S)", on: true },
    { key: "wireframe", title: "Wireframe", hint: "The triangles (W)", on: false },
    { key: "normals", title: "Normals", hint: "The normals as colours (N)", on: false },
    { key: "bare", title: "Blendshapes only", hint: "The moving mesh alone: no colour, no maps (B)", on: false },
  ], (key, on) => { shown[key](on); redraw(); });

  let loadingRig = null;
  async function useRig(name) {
    if (name === "transferred" && !avatar.rigs.transferred) {
      toast("Loading the transferred shapes …", 60);
      loadingRig ??= loadGlb("data/transferred.glb").then((other) => avatar.addRig("transferred", other));
      try { await loadingRig; } catch (error) { loadingRig = null; toast(`The transferred shapes cannot be loaded: ${error.message}`, 8); return; }
      toast("Shapes as the template has them, before the video taught any", 3);
    }
    avatar.useRig(name);
    for (const button of $("rigs").children) button.setAttribute("aria-checked", String(button.dataset.rig === name));
    redraw(true);
  }
  for (const [key, title] of [["personalised", "Personalised"], ["transferred", "Transferred"]]) {
    const button = Object.assign(document.createElement("button"), { type: "button", textContent: title });
    button.setAttribute("role", "radio");
    button.setAttribute("aria-checked", String(key === "personalised"));
    button.dataset.rig = key;
    button.disabled = key === "transferred" && !about.transferred;
    button.title = button.disabled ? "Stage blendshapes is not in the project" : "Switch (T)";
    button.addEventListener("click", () => useRig(key));
    $("rigs").append(button);
  }

  // ---- expression
  let glide = null;
  const sliders = slidersIn($("sliders"), $("link"), avatar.extras.evidence, (weights) => {
    quiet();
    pose(weights);
  });
  function pose(weights) {
    avatar.setWeights(weights);
    redraw(true);
  }
  function setWeights(weights) {
    pose(weights);
    sliders.show(avatar.weights);
  }
  // what else moves the face stops when the user takes over
  function quiet() {
    glide = null;
    if (timeline.playing) timeline.pause();
    if (live.active) toggleLive();
  }
  function glideTo(named) {
    quiet();
    glide = { from: Float32Array.from(avatar.weights), to: weightsOf(named), since: performance.now() };
    redraw();
  }
  PRESETS.forEach(({ title, weights }, i) => {
    const button = Object.assign(document.createElement("button"), { type: "button", textContent: title, title: `${title} (${i})` });
    button.addEventListener("click", () => glideTo(weights));
    $("presets").append(button);
  });
  $("reset").addEventListener("click", () => glideTo({}));

  // ---- performance
  const timeline = new Timeline(
    { root: $("timeline"), play: $("play"), time: $("time"), clock: $("clock"), length: $("length"), speed: $("speed"), loop: $("loop"), quality: $("quality") },
    showMoment,
  );
  let motion = false;
  function showMoment() {
    glide = null;
    setWeights(timeline.performance.weightsAt(timeline.time));
    avatar.place(motion ? timeline.performance.placeAt(timeline.time) : null);
    const [i] = timeline.performance.at(timeline.time);
    $("state").textContent = `frame ${i}`;
    redraw(true);
  }
  function setMotion(on) {
    motion = on;
    $("motion").setAttribute("aria-pressed", String(on));
    if (timeline.performance) avatar.place(on ? timeline.performance.placeAt(timeline.time) : null);
    relight();
  }
  const video = $("video");
  function setSide(on) {
    $("side").setAttribute("aria-pressed", String(on));
    $("film").hidden = !on;
    if (on) {
      if (!video.src) {
        $("film-note").textContent = "The video is being prepared …";
        video.src = "data/video.mp4";
      }
      setMotion(true);
      if (video.readyState >= 2) timeline.attach(video);
      film();
    } else {
      timeline.attach(null);
      video.pause();
      setMotion(false);
      frame();
    }
    resize(true);
  }
  video.addEventListener("loadeddata", () => {
    $("film-note").textContent = "";
    if (!$("film").hidden) timeline.attach(video);
  });
  video.addEventListener("error", () => { $("film-note").textContent = "This browser cannot play the video."; });
  $("motion").addEventListener("click", () => setMotion(!motion));
  $("side").addEventListener("click", () => setSide($("film").hidden));
  function usePerformance(data) {
    if (!$("film").hidden) setSide(false);
    setMotion(false);
    const made = new Performance(data);
    timeline.load(made);
    $("side").disabled = !(made.views && about.video);
    $("side").title = made.views ? (missing.video ?? "The video beside it, through the same lens (V)") : "This table belongs to no video";
    $("motion").disabled = !made.views && !made.angles;
  }
  if (about.performance)
    fetched("data/performance.json", "json").then((data) => { usePerformance(data); document.documentElement.dataset.performance = "ready"; },
                                                   (error) => toast(`The performance cannot be loaded: ${error.message}`, 8));

  // ---- in and out
  $("import").addEventListener("click", () => $("file").click());
  async function importTable(file) {
    try {
      usePerformance(readTable(await file.text(), file.name));
      toast(`${file.name}: ${timeline.performance.times.length} frames`);
      timeline.play();
    } catch (error) {
      toast(error.message, 8);
    }
  }
  $("file").addEventListener("change", () => { if ($("file").files[0]) importTable($("file").files[0]); $("file").value = ""; });
  addEventListener("dragover", (event) => event.preventDefault());
  addEventListener("drop", (event) => {
    event.preventDefault();
    if (event.dataTransfer.files[0]) importTable(event.dataTransfer.files[0]);
  });

  const live = new Live(
    (weights, head) => {
      glide = null;
      if (timeline.playing) timeline.pause();
      setWeights(weights);
      avatar.place(head ? new THREE.Quaternion(...head).normalize() : null);
      $("state").textContent = `live, message ${live.count}`;
      redraw(true);
    },
    (text) => {
      $("live").setAttribute("aria-pressed", String(live.active));
      $("live-note").hidden = !text;
      $("live-note").textContent = text ?? "";
      if (!text) $("state").textContent = "";
    },
  );
  function toggleLive() {
    if (live.active) { live.stop(); live.told(null); } else live.start();
    $("live").setAttribute("aria-pressed", String(live.active));
  }
  $("live").disabled = about.live === null;
  if (about.live === null) $("live").title = "Live input needs the running program: avatarbuild view PROJECT";
  $("live").addEventListener("click", toggleLive);

  const recorder = new Recorder(canvas);
  const named = (suffix) => `${about.title.replace(/[^\w.-]+/g, "_")}.${suffix}`;
  async function takePicture() {
    save(await picture(canvas, () => draw()), named("png"));
  }
  async function recordClip() {
    if (recorder.active) { recorder.stop(); return; }
    try {
      const ended = recorder.start();
      $("clip").textContent = "Stop";
      $("clip").classList.add("recording");
      if (timeline.performance && !live.active) {
        timeline.seek(0);
        timeline.ended = () => recorder.stop();
        timeline.play();
      }
      const { blob, suffix } = await ended;
      save(blob, named(suffix));
    } catch (error) {
      toast(error.message, 8);
    }
    timeline.ended = null;
    $("clip").textContent = "Record clip";
    $("clip").classList.remove("recording");
  }
  $("picture").addEventListener("click", takePicture);
  $("clip").addEventListener("click", recordClip);

  // ---- keys
  const KEYS = [
    ["Space", "play, pause", () => timeline.toggle()],
    ["ArrowLeft", "a frame back", () => timeline.step(-1)],
    ["ArrowRight", "a frame on", () => timeline.step(1)],
    ["0 … 8", "neutral and the other presets", null],
    ["F", "the face from the front", frame],
    ["A", "albedo", () => toggles.press("albedo")],
    ["D", "details", () => toggles.press("details")],
    ["E", "relief", () => toggles.press("relief")],
    ["O", "occlusion", () => toggles.press("occlusion")],
    ["S", "light below the skin", () => toggles.press("scatter")],
    ["W", "wireframe", () => toggles.press("wireframe")],
    ["N", "normals", () => toggles.press("normals")],
    ["B", "blendshapes only", () => toggles.press("bare")],
    ["T", "transferred or personalised shapes", () => about.transferred && useRig(avatar.rig === "personalised" ? "transferred" : "personalised")],
    ["M", "the head's motion", () => $("motion").click()],
    ["V", "the video beside it", () => $("side").click()],
    ["L", "link left and right", () => { $("link").checked = !$("link").checked; }],
    ["P", "save a picture", takePicture],
    ["R", "record a clip; again: stop", recordClip],
    ["H", "hide the controls", () => { document.body.classList.toggle("bare"); resize(true); }],
    ["?", "these keys", () => $("keys").showModal()],
  ];
  for (const [key, text] of KEYS) {
    $("keys-list").append(Object.assign(document.createElement("dt"), { textContent: key.replace("Arrow", "") }),
                          Object.assign(document.createElement("dd"), { textContent: text }));
  }
  $("help").addEventListener("click", () => $("keys").showModal());
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || $("keys").open) return;
    const own = event.target.closest?.("input, select, textarea, button, summary");
    const ranged = own?.matches?.("input[type=range], select");
    if (event.key.startsWith("Arrow") && ranged) return;
    if (event.key === " " && own && !ranged) return;
    if (own?.matches?.("select, input:not([type=range], [type=checkbox])")) return;
    if (/^[0-9]$/.test(event.key)) {
      if (PRESETS[event.key]) glideTo(PRESETS[event.key].weights);
      return;
    }
    const wanted = event.key === " " ? "Space" : event.key.length === 1 ? event.key.toUpperCase() : event.key;
    const found = KEYS.find(([key, , action]) => key === wanted && action);
    if (!found) return;
    event.preventDefault();
    found[2]();
  });

  // ---- drawing
  function draw(whole = false) {
    details?.refresh();
    renderer.shadowMap.needsUpdate = (whole || shadowStale) && surface.key.castShadow;
    shadowStale = false;
    renderer.info.reset();
    renderer.render(scene, camera);
  }
  function step() {
    if (timeline.tick()) showMoment();
    if (glide) {
      const share = Math.min((performance.now() - glide.since) / 260, 1), eased = share * share * (3 - 2 * share);
      setWeights(glide.from.map((a, j) => a + eased * (glide.to[j] - a)));
      if (share === 1) glide = null;
      dirty = true;
    }
    if (dirty) {
      dirty = Boolean(glide);
      draw();
    }
    requestAnimationFrame(step);
  }

  frame();
  avatar.place(null);
  useEnvironment("studio");
  draw();
  context.finish?.();
  $("cover").classList.add("gone");
  document.documentElement.dataset.state = "ready";
  performance.mark("first picture");
  step();

  // the full albedo when the first picture stands
  if (renderer.capabilities.maxTextureSize >= 4096) sharpen();
  async function sharpen() {
    try {
      const image = await createImageBitmap(await fetched("data/albedo.jpg", "blob"), { colorSpaceConversion: "none" });
      const old = surface.skin.uniforms.map.value;
      if (image.width <= (old.image?.width ?? 0)) return;
      const texture = new THREE.Texture(image);
      Object.assign(texture, { colorSpace: THREE.SRGBColorSpace, flipY: false, anisotropy: 8, needsUpdate: true });
      avatar.setAlbedo(texture, old);
      old.dispose();
      redraw();
    } catch { /* the smaller one serves */ } finally {
      document.documentElement.dataset.albedo = "ready";
    }
  }

  window.viewer = {
    THREE, avatar, camera, controls, renderer, scene, surface, timeline, toggles, details, light: pad,
    setWeights: (named) => { quiet(); setWeights(Array.isArray(named) ? Float32Array.from(named) : weightsOf(named)); },
    useRig, useEnvironment, setSide, setMotion, importTable, frame, draw, takePicture, recordClip, readTable, toggleLive,
    // mean milliseconds a picture, drawn to the end, over `count` expressions
    measure(count = 10) {
      const pixel = new Uint8Array(4), times = [];
      for (let i = 0; i < count; i++) {
        const since = performance.now();
        setWeights(Float32Array.from({ length: 52 }, (_, j) => 0.05 + 0.05 * ((i + j) % 3)));
        const posed = performance.now();
        shadowStale = true;
        draw();
        context.readPixels(0, 0, 1, 1, context.RGBA, context.UNSIGNED_BYTE, pixel);
        times.push([posed - since, performance.now() - posed]);
      }
      return { cpu: times.map((t) => t[0]), drawn: times.map((t) => t[1]) };
    },
  };
  return undefined;
}

main().catch((error) => {
  console.error(error);
  stop(`The avatar cannot be shown: ${error.message}`);
});
