// A picture with points on it: zoom, pan, loupe, and the dragging of points with mouse, pen or fingers.

const NEAR = { mouse: 13, pen: 18, touch: 26 }; // CSS pixels about a point
const BUTTONS = 50; // CSS pixels at the top that buttons cover
const LOUPE = 84; // CSS pixels, its radius
const STYLE = getComputedStyle(document.documentElement);
export const COLOURS = Object.fromEntries(
  ["detected", "fit", "carried", "corrected"].map((kind) => [kind, STYLE.getPropertyValue(`--${kind}`).trim()]),
);

export class View {
  constructor(canvas, pictures, told) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.pictures = pictures;
    this.told = told; // told(what, detail): 'grab', 'move', 'drop', 'cancel', 'select'
    this.mode = null; // size, box, pictures(), lines(), handles()
    this.scale = 1;
    this.origin = [0, 0]; // of the canvas, in the picture
    this.selected = null;
    this.hovered = null;
    this.loupe = true;
    this.space = false;
    this.pointers = new Map();
    this.action = null;
    this.asked = 0;
    new ResizeObserver(() => this.resize()).observe(canvas);
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => this.up(event));
    canvas.addEventListener("pointercancel", (event) => this.up(event, true));
    canvas.addEventListener("pointerleave", () => this.hover(null));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  resize() {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    const ratio = devicePixelRatio || 1;
    if (!w || !h) return;
    const middle = this.width ? this.toPicture([this.width / 2, this.height / 2]) : null;
    this.canvas.width = Math.round(w * ratio);
    this.canvas.height = Math.round(h * ratio);
    [this.width, this.height] = [w, h];
    if (this.wanted) this.fit(this.wanted);
    else if (middle) this.origin = [middle[0] - w / 2 / this.scale, middle[1] - h / 2 / this.scale];
    this.redraw();
  }

  // the box (left, top, right, bottom) as large as it goes
  fit(box) {
    this.wanted = box;
    if (!this.width) return;
    const [l, t, r, b] = box;
    this.scale = Math.min(this.width / (r - l), (this.height - BUTTONS) / (b - t));
    this.origin = [(l + r) / 2 - this.width / 2 / this.scale, (t + b) / 2 - (this.height + BUTTONS) / 2 / this.scale];
    this.redraw();
  }

  zoom(factor, at = [this.width / 2, this.height / 2]) {
    this.wanted = null;
    const point = this.toPicture(at);
    this.scale = Math.min(Math.max(this.scale * factor, 0.05), 40);
    this.origin = [point[0] - at[0] / this.scale, point[1] - at[1] / this.scale];
    this.redraw();
  }

  pan(dx, dy) {
    this.wanted = null;
    this.origin = [this.origin[0] - dx / this.scale, this.origin[1] - dy / this.scale];
    this.redraw();
  }

  toPicture([x, y]) {
    return [x / this.scale + this.origin[0], y / this.scale + this.origin[1]];
  }

  toScreen([x, y]) {
    return [(x - this.origin[0]) * this.scale, (y - this.origin[1]) * this.scale];
  }

  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  hit(screen, kind) {
    let best = null;
    let least = NEAR[kind] ?? NEAR.touch;
    for (const handle of this.mode?.handles() ?? []) {
      const [x, y] = this.toScreen(handle.at);
      const apart = Math.hypot(x - screen[0], y - screen[1]);
      if (apart < least) [best, least] = [handle, apart];
    }
    return best;
  }

  down(event) {
    this.canvas.focus({ preventScroll: true });
    try {
      this.canvas.setPointerCapture(event.pointerId);
    } catch {
      // a pointer that is gone already
    }
    const at = this.at(event);
    this.pointers.set(event.pointerId, at);
    if (this.pointers.size === 2) {
      if (this.action?.handle) this.told("cancel");
      this.action = { pinch: this.spread() };
      return;
    }
    const handle = !this.space && event.button === 0 ? this.hit(at, event.pointerType) : null;
    if (handle) {
      this.selected = handle.id;
      this.action = { handle, from: at, moved: false };
      this.told("grab", { id: handle.id, shift: event.shiftKey });
    } else {
      this.action = { pan: at, from: at, button: event.button };
    }
    this.pointer = at;
    this.cursor();
    this.redraw();
  }

  move(event) {
    const at = this.at(event);
    this.pointer = at;
    if (this.pointers.has(event.pointerId)) this.pointers.set(event.pointerId, at);
    const { action } = this;
    if (action?.pinch) {
      if (this.pointers.size < 2) return;
      const now = this.spread();
      this.pan(now.middle[0] - action.pinch.middle[0], now.middle[1] - action.pinch.middle[1]);
      this.zoom(now.apart / action.pinch.apart, now.middle);
      action.pinch = now;
    } else if (action?.handle) {
      const by = [(at[0] - action.from[0]) / this.scale, (at[1] - action.from[1]) / this.scale];
      if (action.moved || Math.hypot(at[0] - action.from[0], at[1] - action.from[1]) > 1.5) {
        action.moved = true;
        this.told("move", { by });
      }
      this.redraw();
    } else if (action?.pan) {
      this.pan(at[0] - action.pan[0], at[1] - action.pan[1]);
      action.pan = at;
    } else {
      this.hover(this.hit(at, event.pointerType));
    }
  }

  up(event, cancelled = false) {
    this.pointers.delete(event.pointerId);
    const { action } = this;
    if (action?.pinch) {
      if (this.pointers.size === 0) this.action = null;
      return;
    }
    this.action = null;
    if (action?.handle) this.told(cancelled ? "cancel" : "drop");
    else if (action?.pan && Math.hypot(action.from[0] - action.pan[0], action.from[1] - action.pan[1]) < 2) {
      if (action.button === 0) this.select(null);
    }
    this.cursor();
    this.redraw();
  }

  spread() {
    const [a, b] = [...this.pointers.values()];
    return { middle: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], apart: Math.max(Math.hypot(a[0] - b[0], a[1] - b[1]), 1) };
  }

  wheel(event) {
    event.preventDefault();
    const step = event.deltaMode === 1 ? 24 : 1;
    this.zoom(Math.exp(-event.deltaY * step * (event.ctrlKey ? 0.01 : 0.0016)), this.at(event));
  }

  select(id) {
    this.selected = id;
    this.told("select");
    this.redraw();
  }

  hover(handle) {
    const id = handle?.id ?? null;
    if (id === this.hovered) return;
    this.hovered = id;
    this.cursor();
    this.redraw();
  }

  cursor() {
    this.canvas.classList.toggle("hold", Boolean(this.action));
    this.canvas.classList.toggle("pick", !this.action && !this.space && this.hovered !== null);
  }

  redraw() {
    if (!this.asked) {
      this.asked = requestAnimationFrame(() => {
        this.asked = 0;
        this.draw();
      });
    }
  }

  draw() {
    if (!this.mode || !this.width) return;
    const { context } = this;
    const ratio = this.canvas.width / this.width;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    paint(context, this.mode, this.pictures, this.scale, this.origin, ratio, this);
    if (this.loupe && this.action?.handle) this.magnify(ratio);
  }

  // what lies under the dragged point, larger, in a corner that the hand does not cover
  magnify(ratio) {
    const { context } = this;
    const handle = this.mode.handles().find((one) => one.id === this.action.handle.id);
    if (!handle) return;
    const left = this.pointer[0] > this.width / 2;
    const x = left ? LOUPE + 12 : this.width - LOUPE - 12;
    const y = LOUPE + (left ? 12 : 58);
    const scale = Math.max(this.scale * 3, 4);
    context.save();
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.beginPath();
    context.arc(x, y, LOUPE, 0, 2 * Math.PI);
    context.fillStyle = "#000";
    context.fill();
    context.clip();
    const origin = [handle.at[0] - x / scale, handle.at[1] - y / scale];
    paint(context, bare(this.mode), this.pictures, scale, origin, ratio);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.strokeStyle = "#fffc";
    context.lineWidth = 1;
    context.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(x + 5 * dx, y + 5 * dy);
      context.lineTo(x + 22 * dx, y + 22 * dy);
    }
    context.stroke();
    context.restore();
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.beginPath();
    context.arc(x, y, LOUPE, 0, 2 * Math.PI);
    context.lineWidth = 2;
    context.strokeStyle = "#fffa";
    context.stroke();
  }
}

// left, top, right, bottom of points, with room about them as a share of their larger extent
export function boxAround(points, room) {
  const [xs, ys] = [points.map(([x]) => x), points.map(([, y]) => y)];
  const [l, t, r, b] = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  const about = room * Math.max(r - l, b - t);
  return [l - about, t - about, r + about, b + about];
}

// a mode without its points
export function bare(mode, lines = true) {
  return { pictures: () => mode.pictures(), lines: () => (lines ? mode.lines() : []), handles: () => [] };
}

// pictures, lines and points of a mode; scale in CSS pixels a pixel of the picture
export function paint(context, mode, pictures, scale, origin, ratio, view = null, size = 1) {
  context.setTransform(ratio * scale, 0, 0, ratio * scale, -origin[0] * scale * ratio, -origin[1] * scale * ratio);
  context.imageSmoothingEnabled = scale < 8;
  context.imageSmoothingQuality = "high";
  for (const [address, [x, y, w, h]] of mode.pictures()) {
    const image = pictures.get(address);
    if (image) context.drawImage(image, x, y, w, h);
  }
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  const place = ([x, y]) => [(x - origin[0]) * scale, (y - origin[1]) * scale];
  for (const line of mode.lines()) {
    context.beginPath();
    for (const point of line.points) context.lineTo(...place(point));
    if (line.closed) context.closePath();
    context.setLineDash(line.dashed ? [4, 4] : []);
    context.globalAlpha = line.faint ? 0.75 : 1;
    if (!line.dashed) {
      context.strokeStyle = "#0009";
      context.lineWidth = (line.width ?? 1.5) * size + 1.5;
      context.stroke();
    }
    context.strokeStyle = COLOURS[line.kind];
    context.lineWidth = (line.width ?? 1.5) * size;
    context.stroke();
  }
  context.setLineDash([]);
  context.globalAlpha = 1;
  for (const handle of mode.handles()) {
    const chosen = view && (handle.id === view.selected || handle.id === view.hovered);
    symbol(context, handle.kind, ...place(handle.at), (chosen ? 1.5 : 1) * size, handle.sure ?? 1);
    if (view && handle.id === view.selected) {
      context.beginPath();
      context.arc(...place(handle.at), 11, 0, 2 * Math.PI);
      context.strokeStyle = "#fff";
      context.lineWidth = 1.5;
      context.stroke();
    }
  }
}

// ring: detected or fitted; diamond: carried by the flow; dot: set by hand
export function symbol(context, kind, x, y, size = 1, sure = 1) {
  const r = 4.2 * size;
  context.globalAlpha = 0.35 + 0.65 * sure;
  context.beginPath();
  if (kind === "carried") {
    context.moveTo(x, y - 1.3 * r);
    context.lineTo(x + 1.3 * r, y);
    context.lineTo(x, y + 1.3 * r);
    context.lineTo(x - 1.3 * r, y);
    context.closePath();
  } else {
    context.arc(x, y, kind === "corrected" ? 1.1 * r : r, 0, 2 * Math.PI);
  }
  context.lineWidth = 3.2 * Math.max(size, 0.6);
  context.strokeStyle = "#000b";
  context.stroke();
  if (kind === "corrected" || kind === "carried") {
    context.fillStyle = COLOURS[kind];
    context.fill();
  }
  context.lineWidth = 1.6 * Math.max(size, 0.6);
  context.strokeStyle = kind === "corrected" ? "#fff" : COLOURS[kind];
  context.stroke();
  context.globalAlpha = 1;
}
