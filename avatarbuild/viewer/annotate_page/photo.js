// The frontal photo: lids, lips and brows as lines whose corners can be dragged.

import { toCanvas } from "./store.js";
import { boxAround } from "./view.js";

const RINGS = [
  { name: "right eye", lines: ["lidUpperRight", "lidLowerRight"] },
  { name: "left eye", lines: ["lidUpperLeft", "lidLowerLeft"] },
  { name: "outer lips", lines: ["lipsOuterUpper", "lipsOuterLower"] },
  { name: "inner lips", lines: ["lipsInnerUpper", "lipsInnerLower"] },
  { name: "right brow", lines: ["browRight"] },
  { name: "left brow", lines: ["browLeft"] },
];
const SOFT = 1.3; // corners of the line: how far a soft drag reaches

export class PhotoMode {
  constructor(about, store) {
    this.tab = "photo";
    this.about = about;
    this.store = store;
    this.size = about.size;
    this.box = about.box;
    this.name = about.name;
    this.pull = "soft";
    this.reference = true;
    this.prefills = { detector: {}, fit: {} };
    for (const contour of about.contours) {
      this.prefills.detector[contour.name] = contour.detector.map(toCanvas);
      if (contour.fit) this.prefills.fit[contour.name] = contour.fit.map(toCanvas);
    }
    this.fitted = Object.keys(this.prefills.fit).length > 0;
    this.base = this.fitted ? "fit" : "detector";
  }

  where() {
    return { tab: "photo" };
  }

  pictures() {
    const [l, t, r, b] = this.box;
    return [["picture/photo/whole", [0, 0, ...this.size]], ["picture/photo/face", [l, t, r - l, b - t]]];
  }

  // what a button shows: the face, the eyes, the mouth
  part(name) {
    if (name === "whole") return [0, 0, ...this.size];
    const wanted = { face: /./, eyes: /lid|brow/, mouth: /lips/ }[name];
    const points = RINGS.flatMap((ring) => ring.lines.filter((line) => wanted.test(line)).flatMap((line) => this.line(line)));
    return boxAround(points, name === "face" ? 0.3 : 0.12);
  }

  drawn() {
    return this.store.doc.photo[this.name] ?? {};
  }

  line(contour) {
    return this.drawn()[contour] ?? this.prefills[this.base][contour] ?? this.prefills.detector[contour];
  }

  kind(ring) {
    if (ring.lines.some((contour) => contour in this.drawn())) return "corrected";
    return this.base === "fit" && this.fitted ? "fit" : "detected";
  }

  // the corners of a ring in order: along the first line, and back along the second without its ends
  corners(ring) {
    const [upper, lower] = ring.lines;
    const ids = this.line(upper).map((_, i) => `${upper}:${i}`);
    const under = lower ? this.line(lower).map((_, i) => `${lower}:${i}`).slice(1, -1).reverse() : [];
    return [...ids, ...under];
  }

  point(id) {
    const [contour, i] = id.split(":");
    return this.line(contour)[Number(i)];
  }

  ringOf(id) {
    const contour = id.split(":")[0];
    return RINGS.find((ring) => ring.lines.includes(contour));
  }

  handles() {
    return RINGS.flatMap((ring) => {
      const kind = this.kind(ring);
      return this.corners(ring).map((id) => ({ id, at: this.point(id), kind }));
    });
  }

  lines() {
    const lines = [];
    for (const ring of RINGS) {
      const kind = this.kind(ring);
      if (this.reference) {
        const other = kind === "corrected" ? this.base : this.base === "fit" ? "detector" : "fit";
        for (const contour of ring.lines) {
          const points = this.prefills[other][contour];
          const from = other === "fit" ? "fit" : "detected";
          if (points) lines.push({ points, kind: from, dashed: true, width: 1.2, faint: true });
        }
      }
      const [upper, lower] = ring.lines;
      const points = [...this.line(upper), ...(lower ? this.line(lower).slice(1, -1).reverse() : [])];
      lines.push({ points, kind, closed: Boolean(lower), width: 1.6 });
    }
    return lines;
  }

  // which corners a drag of one of them moves, and by how much of its way
  shares(id, pull) {
    const ring = this.ringOf(id);
    const ids = this.corners(ring);
    if (pull === "point") return new Map([[id, 1]]);
    if (pull === "part") return new Map(ids.map((one) => [one, 1]));
    const own = ids.indexOf(id);
    const shares = new Map();
    ids.forEach((one, i) => {
      let apart = Math.abs(i - own);
      if (ring.lines.length > 1) apart = Math.min(apart, ids.length - apart);
      const share = Math.exp(-0.5 * (apart / SOFT) ** 2);
      if (share > 0.03) shares.set(one, share);
    });
    return shares;
  }

  begin() {
    this.store.begin("photo", this.name, this.where());
  }

  set(places) {
    const drawn = { ...this.drawn() };
    for (const ring of RINGS) {
      const own = [...places].filter(([id]) => ring.lines.includes(id.split(":")[0]));
      if (!own.length) continue;
      const [upper, lower] = ring.lines;
      for (const contour of ring.lines) drawn[contour] = this.line(contour).map((at) => [...at]);
      for (const [id, at] of own) {
        const [contour, i] = id.split(":");
        drawn[contour][Number(i)] = at;
      }
      if (lower) {
        drawn[lower][0] = [...drawn[upper][0]];
        drawn[lower][drawn[lower].length - 1] = [...drawn[upper].at(-1)];
      }
    }
    this.store.put("photo", this.name, drawn);
  }

  remove(id) {
    const drawn = { ...this.drawn() };
    for (const contour of this.ringOf(id).lines) delete drawn[contour];
    this.begin();
    this.store.put("photo", this.name, drawn);
    this.store.commit();
  }

  clear() {
    this.begin();
    this.store.put("photo", this.name, undefined);
    this.store.commit();
  }

  count() {
    return RINGS.filter((ring) => this.kind(ring) === "corrected").length;
  }

  label(id) {
    return this.ringOf(id).name;
  }

  title() {
    return this.name;
  }

  facts() {
    const count = this.count();
    return count
      ? `${count} of ${RINGS.length} parts drawn by hand. The next run takes them in place of the detector's.`
      : "Drag a line where it does not lie on the lid, the lip or the middle of the brow. What you leave alone stays as it is.";
  }
}
