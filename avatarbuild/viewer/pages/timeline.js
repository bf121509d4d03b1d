// A performance on a time line: its weights and poses between frames, its clock, and the video that runs beside it.
import { THREE } from "./three.js";
import { NAMES } from "./shapes.js";

const FLIP = new THREE.Matrix4().makeScale(1, -1, -1); // OpenCV's camera axes <-> three's

export class Performance {
  // times (f,); weights (f, 52); poses (f, 12) or null; head angles yaw, pitch, roll (f, 3) or null; quality or null
  constructor({ name, times, weights, poses, quality, head = null, angles = null, focal, size }) {
    Object.assign(this, { name, times, weights, quality, focal, size });
    this.angles = head ?? angles;
    this.length = times.length > 1 ? times[times.length - 1] : 1 / 30;
    this.current = new Float32Array(NAMES.length);
    this.views = null;
    if (poses) {
      this.views = poses.map((p) => new THREE.Matrix4().set(...p, 0, 0, 0, 1).premultiply(FLIP));
      const good = quality ? quality.findIndex((q) => q >= 0.5) : 0;
      this.camera = this.views[Math.max(good, 0)].clone().invert(); // the video's camera, in the scene at rest
    }
  }

  // frames i, i + 1 and the share of the second at a time
  at(time) {
    const { times } = this;
    let low = 0, high = times.length - 1;
    while (low < high - 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= time) low = middle; else high = middle;
    }
    const span = times[high] - times[low];
    return [low, high, span > 0 ? Math.min(Math.max((time - times[low]) / span, 0), 1) : 0];
  }

  weightsAt(time) {
    const [i, j, share] = this.at(time), a = this.weights[i], b = this.weights[j];
    for (let k = 0; k < this.current.length; k++) this.current[k] = a[k] + share * (b[k] - a[k]);
    return this.current;
  }

  // where the head is: as filmed (Matrix4), else as its angles say (Quaternion), else null
  placeAt(time) {
    const [i, j, share] = this.at(time);
    if (this.views) {
      const parts = [i, j].map((frame) => {
        const at = new THREE.Vector3(), turn = new THREE.Quaternion();
        this.camera.clone().multiply(this.views[frame]).decompose(at, turn, new THREE.Vector3());
        return { at, turn };
      });
      return new THREE.Matrix4().compose(
        parts[0].at.lerp(parts[1].at, share), parts[0].turn.slerp(parts[1].turn, share), new THREE.Vector3(1, 1, 1));
    }
    if (!this.angles) return null;
    const turn = ([yaw, pitch, roll]) =>
      new THREE.Quaternion().setFromEuler(new THREE.Euler(-pitch, yaw, -roll, "ZXY"));
    return turn(this.angles[i]).slerp(turn(this.angles[j]), share);
  }
}

export class Timeline {
  constructor(elements, moved) {
    this.e = elements;
    this.moved = moved;
    this.time = 0;
    this.playing = false;
    this.speed = 1;
    this.loop = true;
    this.performance = null;
    this.video = null;
    const { e } = this;
    e.play.addEventListener("click", () => this.toggle());
    e.time.addEventListener("input", () => { this.pause(); this.seek(Number(e.time.value)); });
    e.speed.addEventListener("change", () => {
      this.speed = Number(e.speed.value);
      if (this.video) this.video.playbackRate = this.speed;
      this.start();
    });
    e.loop.addEventListener("click", () => {
      this.loop = !this.loop;
      e.loop.setAttribute("aria-pressed", String(this.loop));
    });
  }

  load(performance) {
    this.pause();
    this.performance = performance;
    const { e } = this;
    e.root.hidden = false;
    e.time.max = performance.length;
    e.length.value = performance.length.toFixed(2);
    this.drawQuality();
    this.seek(0, false);
  }

  drawQuality() {
    const { quality } = this.e, { performance } = this, width = 512;
    quality.width = width;
    const context = quality.getContext("2d");
    context.clearRect(0, 0, width, quality.height);
    if (!performance.quality) return;
    const { times } = performance;
    performance.quality.forEach((value, i) => {
      const from = width * times[i] / performance.length, to = width * (times[i + 1] ?? performance.length) / performance.length;
      context.fillStyle = value >= 0.5 ? "#3f6f58" : value > 0 ? "#8a6a2d" : "#8a3238";
      context.fillRect(from, 0, Math.max(to - from, 1), quality.height);
    });
  }

  // the video becomes the clock while it is shown
  attach(video) {
    this.video = video;
    if (!video) return this.start();
    video.playbackRate = this.speed;
    video.currentTime = this.time;
    if (this.playing) video.play().catch(() => {});
    return undefined;
  }

  start() {
    this.from = this.time;
    this.since = performance.now();
  }

  play() {
    if (!this.performance) return;
    if (this.time >= this.performance.length - 1e-3) this.seek(0);
    this.playing = true;
    this.start();
    if (this.video) this.video.play().catch(() => {});
    this.showPlaying();
  }

  pause() {
    this.playing = false;
    if (this.video) this.video.pause();
    this.showPlaying();
  }

  toggle() {
    if (this.playing) this.pause(); else this.play();
  }

  showPlaying() {
    this.e.play.textContent = this.playing ? "❚❚" : "▶";
    this.e.play.setAttribute("aria-label", this.playing ? "Pause" : "Play");
  }

  seek(time, tell = true) {
    if (!this.performance) return;
    this.time = Math.min(Math.max(time, 0), this.performance.length);
    this.start();
    if (this.video && Math.abs(this.video.currentTime - this.time) > 0.02) this.video.currentTime = this.time;
    this.show();
    if (tell) this.moved();
  }

  step(frames) {
    if (!this.performance) return;
    this.pause();
    const { times } = this.performance, [i, , share] = this.performance.at(this.time);
    const now = share > 0.5 ? i + 1 : i;
    this.seek(times[Math.min(Math.max(now + frames, 0), times.length - 1)]);
  }

  // called for every picture; true where the time has moved
  tick() {
    if (!this.playing) return false;
    const video = this.video && this.video.readyState >= 2 && !this.video.seeking ? this.video : null;
    const time = video ? video.currentTime : this.from + this.speed * (performance.now() - this.since) / 1000;
    if (time >= this.performance.length || video?.ended) {
      if (!this.loop) {
        this.seek(this.performance.length, false);
        this.pause();
        this.ended?.();
        return true;
      }
      this.ended?.();
      this.seek(0, false);
      if (this.video) this.video.play().catch(() => {});
      return true;
    }
    this.time = time;
    this.show();
    return true;
  }

  show() {
    this.e.time.value = this.time;
    this.e.time.style.setProperty("--at", `${100 * this.time / this.performance.length}%`);
    this.e.clock.value = this.time.toFixed(2);
  }
}
