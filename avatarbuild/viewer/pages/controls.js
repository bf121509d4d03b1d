// The full avatar and what the controls do with it. window.viewer is the same from a script (docs/viewer.md).
import { THREE } from "./three.js";
import { Avatar, loadGlb } from "./avatar.js";
import { fetched } from "./context.js";
import { loadDetails } from "./details.js";
import { keysIn } from "./keys.js";
import { lighting } from "./light.js";
import { Live } from "./live.js";
import { slidersIn, togglesIn } from "./panel.js";
import { picture, Recorder, save } from "./record.js";
import { PRESETS, readTable, weightsOf } from "./shapes.js";
import { Performance, Timeline } from "./timeline.js";

const $ = (id) => document.getElementById(id);
const GLIDE = 260; // milliseconds from one preset to the next
const MAPS = ["albedo", "details", "relief", "occlusion"];

const toast = (() => {
  let timer = 0;
  return (text, seconds = 4) => {
    $("toast").textContent = text;
    $("toast").hidden = false;
    clearTimeout(timer);
    timer = setTimeout(() => { $("toast").hidden = true; }, 1000 * seconds);
  };
})();

// scene.json, the avatar with its materials, and why what is missing is missing
async function load(stage, surface) {
  const traits = fetched("data/traits.bin", "arrayBuffer"); // the program takes its time over it
  traits.catch(() => {});
  const scene = fetched("data/scene.json", "json");
  const played = scene.then(({ performance }) => (performance ? fetched("data/performance.json", "json") : null));
  played.catch(() => {});
  const [about, gltf, vertex, fragment, synthesis] = await Promise.all([
    scene,
    loadGlb("data/avatar.glb"),
    ...["surface.vert.glsl", "surface.frag.glsl", "synthesis.glsl"].map((name) => fetched(name, "text")),
  ]);
  if (about.version !== 1) throw new Error(`scene.json has version ${about.version}, 1 is needed`);
  const [details] = await Promise.allSettled([about.details ? loadDetails("data/details", stage.renderer, synthesis) : null]);
  if (details.status === "rejected") about.missing.details = `The details cannot be read (${details.reason.message}).`;
  surface.use({ vertex, fragment, synthesis }, details.value ?? null);
  const avatar = new Avatar(gltf, surface, details.value ?? null);
  try {
    const data = await traits;
    avatar.tell([...new Uint32Array(data, 0, 2)], new Uint8Array(data, 8));
  } catch (fault) {
    toast(`Lips and scalp look like the rest of the skin: ${fault.message}`, 8);
  }
  return { about, avatar, details: avatar.details, played };
}

// first: what the first picture shows, taken away when the full one is there; null for none
export async function control(stage, surface, first) {
  const { about, avatar, details, played } = await load(stage, surface);
  const { missing } = about;
  document.title = `${about.title} – avatar`;
  $("name").textContent = about.title;
  stage.take(avatar, surface);
  const light = lighting({ pad: $("pad"), environment: $("environment"), turn: $("turn"), ambient: $("ambient"), key: $("key") },
                         surface, stage, about.light);

  // ---- what is shown
  const uniforms = surface.shared;
  let kept = [];
  const shown = {
    albedo: (on) => { uniforms.show_albedo.value = on; },
    details: (on) => { uniforms.show_details.value = on; },
    relief: (on) => { uniforms.show_relief.value = on; },
    occlusion: (on) => { uniforms.show_occlusion.value = on; },
    scatter: (on) => { uniforms.show_skin_light.value = on; },
    wireframe: (on) => avatar.showWires(on),
    normals: (on) => { uniforms.show_normals.value = on; },
    bare: (on) => {
      if (on) kept = MAPS.filter((key) => toggles.on(key));
      for (const key of on ? MAPS : kept) toggles.set(key, !on);
    },
  };
  const toggles = togglesIn($("toggles"), [
    { key: "albedo", title: "Albedo", hint: "The skin's colour (A)", on: true },
    { key: "details", title: "Details", hint: missing.details ?? "Wrinkles that follow the expression (D)", on: Boolean(details), disabled: !details },
    { key: "relief", title: "Relief", hint: "The normal map of the face at rest (E)", on: true },
    { key: "occlusion", title: "Occlusion", hint: "Hollows get less light (O)", on: true },
    { key: "scatter", title: "Skin light", hint: "Light that scatters below the skin (S)", on: true },
    { key: "wireframe", title: "Wireframe", hint: "The triangles (W)", on: false },
    { key: "normals", title: "Normals", hint: "The normals as colours (N)", on: false },
    { key: "bare", title: "Blendshapes only", hint: "The moving mesh alone: no colour, no maps (B)", on: false },
  ], (key, on) => { shown[key](on); stage.redraw(); });

  let other = null; // the promise of the transferred rig
  async function useRig(name) {
    if (name === "transferred" && !avatar.rigs.transferred) {
      toast("Loading the transferred shapes …", 60);
      other ??= loadGlb("data/transferred.glb").then((gltf) => avatar.addRig("transferred", gltf));
      try {
        await other;
      } catch (error) {
        other = null;
        toast(`The transferred shapes cannot be loaded: ${error.message}`, 8);
        return;
      }
      toast("Shapes as the template has them, before the video taught any", 3);
    }
    avatar.useRig(name);
    for (const button of $("rigs").children) button.setAttribute("aria-checked", String(button.dataset.rig === name));
    stage.redraw(true);
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
    avatar.setWeights(weights);
    stage.redraw(true);
  });
  function setWeights(weights) {
    avatar.setWeights(weights);
    sliders.show(avatar.weights);
    stage.redraw(true);
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
  }
  function gliding() {
    const share = Math.min((performance.now() - glide.since) / GLIDE, 1), eased = share * share * (3 - 2 * share);
    setWeights(glide.from.map((a, j) => a + eased * (glide.to[j] - a)));
    if (share === 1) glide = null;
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
    const { performance: played, time } = timeline;
    setWeights(played.weightsAt(time));
    avatar.place(motion ? played.placeAt(time) : null);
    $("state").textContent = `frame ${played.at(time)[0]}`;
  }
  function setMotion(on) {
    motion = on;
    $("motion").setAttribute("aria-pressed", String(on));
    avatar.place(on && timeline.performance ? timeline.performance.placeAt(timeline.time) : null);
    light.relight();
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
      if (video.readyState >= 2) timeline.attach(video);
      const { camera, size, focal } = timeline.performance;
      stage.lookThrough(camera, size, focal);
    } else {
      timeline.attach(null);
      video.pause();
      stage.frame();
    }
    setMotion(on);
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

  // ---- in and out
  async function importTable(file) {
    try {
      usePerformance(readTable(await file.text(), file.name));
      toast(`${file.name}: ${timeline.performance.times.length} frames`);
      timeline.play();
    } catch (error) {
      toast(error.message, 8);
    }
  }
  $("import").title = missing.performance ?? $("import").title;
  $("import").addEventListener("click", () => $("file").click());
  $("file").addEventListener("change", () => {
    if ($("file").files[0]) importTable($("file").files[0]);
    $("file").value = "";
  });
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
    },
    (text) => {
      $("live").setAttribute("aria-pressed", String(live.active));
      $("live-note").hidden = !text;
      $("live-note").textContent = text ?? "";
      if (!text) $("state").textContent = "";
    },
  );
  function toggleLive() {
    if (live.active) {
      live.stop();
      live.told(null);
    } else live.start();
    $("live").setAttribute("aria-pressed", String(live.active));
  }
  $("live").disabled = about.live === null;
  if (about.live === null) $("live").title = "Live input needs the running program: avatarbuild view PROJECT";
  $("live").addEventListener("click", toggleLive);

  const recorder = new Recorder($("canvas"));
  const named = (suffix) => `${about.title.replace(/[^\w.-]+/g, "_")}.${suffix}`;
  const takePicture = async () => save(await picture($("canvas"), () => stage.draw()), named("png"));
  async function recordClip() {
    if (recorder.active) {
      recorder.stop();
      return;
    }
    try {
      stage.steady = true;
      stage.draw();
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
    stage.steady = false;
    timeline.ended = null;
    $("clip").textContent = "Record clip";
    $("clip").classList.remove("recording");
  }
  $("picture").addEventListener("click", takePicture);
  $("clip").addEventListener("click", recordClip);
  $("help").addEventListener("click", () => $("keys").showModal());

  const toggle = (key) => () => toggles.press(key), click = (id) => () => $(id).click();
  keysIn({ dialog: $("keys"), list: $("keys-list") }, [
    ["Space", "play, pause", () => timeline.toggle()],
    ["ArrowLeft", "a frame back", () => timeline.step(-1)],
    ["ArrowRight", "a frame on", () => timeline.step(1)],
    ["0 … 8", "neutral and the other presets", null],
    ["F", "the face from the front", () => stage.frame()],
    ["A", "albedo", toggle("albedo")],
    ["D", "details", toggle("details")],
    ["E", "relief", toggle("relief")],
    ["O", "occlusion", toggle("occlusion")],
    ["S", "light below the skin", toggle("scatter")],
    ["W", "wireframe", toggle("wireframe")],
    ["N", "normals", toggle("normals")],
    ["B", "blendshapes only", toggle("bare")],
    ["T", "transferred or personalised shapes", () => about.transferred && useRig(avatar.rig === "personalised" ? "transferred" : "personalised")],
    ["M", "the head's motion", click("motion")],
    ["V", "the video beside it", click("side")],
    ["L", "link left and right", click("link")],
    ["P", "save a picture", takePicture],
    ["R", "record a clip; again: stop", recordClip],
    ["H", "hide the controls", () => { document.body.classList.toggle("bare"); stage.resize(true); }],
    ["?", "these keys", click("help")],
  ], (digit) => PRESETS[digit] && glideTo(PRESETS[digit].weights));

  // ---- the full picture, once its shaders are compiled; then the rest
  avatar.place(null);
  light.use("studio");
  try {
    const data = await played;
    if (data) usePerformance(data);
  } catch (fault) {
    toast(`The performance cannot be loaded: ${fault.message}`, 8);
  }
  await stage.show(first);
  stage.moved = () => {
    if (timeline.tick()) showMoment();
    if (glide) gliding();
  };
  stage.run();
  $("cover").classList.add("gone");
  await stage.painted();
  performance.mark("full picture");
  $("state").textContent = "";

  // texels that the picture would not show are not fetched
  async function sharpen() {
    const image = await createImageBitmap(await fetched("data/albedo.jpg", "blob"), { colorSpaceConversion: "none" });
    if (image.width > stage.renderer.capabilities.maxTextureSize) return;
    const texture = new THREE.Texture(image), old = surface.skin.uniforms.map.value;
    Object.assign(texture, { colorSpace: THREE.SRGBColorSpace, flipY: false, anisotropy: old.anisotropy, needsUpdate: true });
    avatar.setAlbedo(texture, old);
    old.dispose();
    stage.redraw();
  }
  if (about.albedo) stage.near = () => sharpen().catch((fault) => toast(`The full albedo cannot be loaded: ${fault.message}`, 8));

  window.viewer = {
    THREE, stage, avatar, details, surface, timeline, toggles, light,
    setWeights: (values) => {
      quiet();
      setWeights(Array.isArray(values) ? Float32Array.from(values) : weightsOf(values));
    },
    useRig, setSide, setMotion, importTable, readTable, takePicture, recordClip, toggleLive,
    measure: (count = 10) => stage.measure(count, (i) => setWeights(Float32Array.from({ length: 52 }, (_, j) => 0.05 + 0.05 * ((i + j) % 3)))),
  };
  document.documentElement.dataset.state = document.documentElement.dataset.whole = "ready";
}
