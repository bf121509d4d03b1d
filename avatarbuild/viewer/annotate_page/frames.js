// The video's processed frames: 68 points each, carried to the neighbours by the tracker's own flow.

import { toCanvas } from "./store.js";
import { boxAround } from "./view.js";

const CHAINS = [
  { name: "jaw", of: [[0, 17]] },
  { name: "right brow", of: [[17, 22]] },
  { name: "left brow", of: [[22, 27]] },
  { name: "nose", of: [[27, 31], [31, 36]] },
  { name: "right eye", of: [[36, 42]], closed: true },
  { name: "left eye", of: [[42, 48]], closed: true },
  { name: "mouth", of: [[48, 60], [60, 68]], closed: true },
];
const COUNT = 68;
const SOFT = 1.2;
const LEAST = 0.15; // confidence below which a carried point is not shown
const WAIT = 110; // ms between questions to the flow
const numbers = ([from, to]) => Array.from({ length: to - from }, (_, i) => from + i);
const chainOf = (k) => CHAINS.find((chain) => chain.of.some(([from, to]) => k >= from && k < to));

export class FramesMode {
  constructor(about, store, live, told) {
    this.tab = "frames";
    this.store = store;
    this.live = live;
    this.told = told; // called when the flow has carried points
    this.size = about.size;
    this.file = about.file;
    this.frames = about.frames;
    this.worst = about.worst;
    this.rows = new Map(this.frames.map((row, i) => [row.frame, i]));
    for (const row of this.frames) {
      row.points = row.points?.map(toCanvas) ?? null;
      row.fit = row.fit?.map(toCanvas) ?? null;
    }
    this.pull = "point";
    this.reference = false;
    this.carried = {};
    this.ready = 1;
    this.fault = "";
    this.asking = false;
    this.again = false;
    this.frame = this.worst[0];
  }

  get row() {
    return this.frames[this.rows.get(this.frame)];
  }

  get box() {
    return this.row.box;
  }

  // what a button shows: the face, the eyes, the mouth
  part(name) {
    if (name === "whole") return [0, 0, ...this.size];
    const points = this.row.points;
    if (!points) return this.box;
    const [from, to] = { face: [0, COUNT], eyes: [17, 48], mouth: [48, 68] }[name];
    return boxAround(points.slice(from, to), name === "face" ? 0.1 : 0.25);
  }

  where() {
    return { tab: "frames", frame: this.frame };
  }

  of(frame) {
    // the same interface for another frame: what the small pictures draw
    return Object.assign(Object.create(this), { frame, reference: false });
  }

  pictures() {
    const [l, t, r, b] = this.box;
    const face = [`picture/frame/${this.frame}/face`, [l, t, r - l, b - t]];
    return [[`picture/frame/${this.frame}/whole`, [0, 0, ...this.size]], face];
  }

  open(frame) {
    this.frame = frame;
    this.ask();
  }

  told68() {
    return this.store.doc.video[this.frame] ?? {};
  }

  point(k) {
    const set = this.told68()[k];
    if (set) return { at: set, kind: "corrected", sure: 1 };
    const carried = this.carried[this.frame]?.[k];
    if (carried && carried[2] >= LEAST) return { at: toCanvas(carried), kind: "carried", sure: carried[2] };
    return this.row.points ? { at: this.row.points[k], kind: "detected", sure: 1 } : null;
  }

  handles() {
    const handles = [];
    for (let k = 0; k < COUNT; k++) {
      const point = this.point(k);
      if (point) handles.push({ id: k, ...point });
    }
    return handles;
  }

  lines() {
    const lines = [];
    for (const chain of CHAINS) {
      for (const part of chain.of) {
        const points = numbers(part).map((k) => this.point(k));
        if (points.some((point) => !point)) continue;
        const kinds = points.map((point) => point.kind);
        const kind = ["corrected", "carried"].find((one) => kinds.includes(one)) ?? "detected";
        lines.push({ points: points.map((point) => point.at), kind, closed: chain.closed, width: 1, faint: true });
        if (this.reference && this.row.fit) {
          const fit = numbers(part).map((k) => this.row.fit[k]);
          lines.push({ points: fit, kind: "fit", closed: chain.closed, dashed: true, width: 1.4 });
        }
      }
    }
    return lines;
  }

  shares(id, pull) {
    if (pull === "point") return new Map([[id, 1]]);
    const chain = chainOf(id);
    const shares = new Map();
    for (const part of chain.of) {
      const ids = numbers(part).filter((k) => this.point(k));
      for (const k of ids) {
        if (pull === "part") shares.set(k, 1);
        else if (ids.includes(id)) {
          let apart = Math.abs(k - id);
          if (chain.closed) apart = Math.min(apart, ids.length - apart);
          const share = Math.exp(-0.5 * (apart / SOFT) ** 2);
          if (share > 0.03) shares.set(k, share);
        }
      }
    }
    return shares;
  }

  begin() {
    this.store.begin("video", String(this.frame), this.where());
  }

  set(places) {
    const points = { ...this.told68() };
    for (const [k, at] of places) points[k] = at;
    this.store.put("video", String(this.frame), points);
    this.ask();
  }

  remove(id) {
    const points = { ...this.told68() };
    delete points[id];
    this.begin();
    this.store.put("video", String(this.frame), points);
    this.store.commit();
    this.ask();
  }

  clear() {
    this.begin();
    this.store.put("video", String(this.frame), undefined);
    this.store.commit();
    this.ask();
  }

  // the carried points of this frame become points set by hand
  keep() {
    this.begin();
    const kept = this.handles().filter((handle) => handle.kind === "carried");
    this.set(new Map(kept.map((handle) => [handle.id, handle.at])));
    this.store.commit();
  }

  state(frame) {
    if (this.store.doc.video[frame]) return "corrected";
    const points = this.carried[frame];
    return points && Object.values(points).some((point) => point[2] >= LEAST) ? "carried" : "detected";
  }

  reviewed() {
    return this.store.doc.reviewed.list ?? [];
  }

  review(frame, done) {
    const list = this.reviewed().filter((one) => one !== frame);
    if (done) list.push(frame);
    this.store.begin("reviewed", "list", this.where());
    this.store.put("reviewed", "list", list.sort((a, b) => a - b));
    this.store.commit();
  }

  beside(step) {
    const i = this.rows.get(this.frame) + step;
    return this.frames[i]?.frame ?? null;
  }

  nextWorst() {
    const done = new Set(this.reviewed());
    return this.worst.find((frame) => frame !== this.frame && !done.has(frame) && this.frames[this.rows.get(frame)].found) ?? null;
  }

  // asks what the flow makes of the points, one question at a time, and again until it knows all
  async ask() {
    if (!this.live) return;
    if (this.asking) {
      this.again = true;
      return;
    }
    this.asking = true;
    try {
      const { version, video } = this.store.content();
      const answer = await fetch(`propagate/${this.frame}`, {
        method: "POST",
        headers: { "Content-Type": "application/json" },
        body: JSON.stringify({ version, video }),
      });
      if (answer.ok) {
        const said = await answer.json();
        this.carried = said.frames;
        this.ready = said.ready;
        this.fault = said.fault;
        this.told();
      }
    } catch {
      // the saving tells that the program does not answer
    }
    setTimeout(() => {
      this.asking = false;
      const more = this.ready < 1;
      if (this.again || more) {
        this.again = false;
        this.ask();
      }
    }, this.again ? WAIT : 4 * WAIT);
  }

  count() {
    return Object.keys(this.store.doc.video).length;
  }

  label(id) {
    return `${chainOf(id).name}, point ${id}`;
  }

  title() {
    return `Frame ${this.frame}`;
  }

  facts() {
    const row = this.row;
    if (!row.found) return "The detector found no face in this frame: it is not tracked.";
    const told = [`${row.time.toFixed(2)} s`];
    if (row.quality === null) told.push(`detector ${(100 * row.presence).toFixed(1)} %`);
    else told.push(`tracking's quality ${row.quality.toFixed(2)}`, `points ${row.residual.toFixed(1)} mm off the tracked head`);
    const set = Object.keys(this.told68()).length;
    if (set) told.push(`${set} points set by hand`);
    return told.join(" · ");
  }
}
