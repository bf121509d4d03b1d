// What the user has set: the content of corrections.json, with undo and saving.
// Inside the page the first pixel's centre is at 0.5, as the canvas has it; in what is sent it is at 0.

const CENTRE = 0.5;
const PAUSE = 500; // ms after the last change
const AGAIN = 3000; // ms after a failure
const SAME_NUDGE = 900; // ms within which nudges are undone at one stroke

const moved = (point, by) => [round(point[0] + by), round(point[1] + by)];
const round = (value) => Math.round(value * 1000) / 1000;
const mapped = (object, change) => Object.fromEntries(Object.entries(object).map(([key, value]) => [key, change(value)]));
const copy = (value) => (value === undefined ? undefined : structuredClone(value));
const same = (a, b) => JSON.stringify(a) === JSON.stringify(b);

export const toCanvas = (point) => [point[0] + CENTRE, point[1] + CENTRE];

function inside(saved) {
  return {
    video: mapped(saved.video ?? {}, (points) => mapped(points, (at) => moved(at, CENTRE))),
    photo: mapped(saved.photo ?? {}, (lines) => mapped(lines, (line) => line.map((at) => moved(at, CENTRE)))),
    reviewed: { list: saved.reviewed ?? [] },
  };
}

export class Store {
  constructor(state, told) {
    this.told = told; // called with what changed: 'edit', 'saving', 'conflict'
    this.doc = inside(state.corrections);
    this.tag = state.tag;
    this.stale = state.stale;
    this.saving = "saved";
    this.fault = "";
    this.done = [];
    this.undone = [];
    this.begun = null;
    this.timer = 0;
    this.version = this.sent = 0;
    addEventListener("focus", () => this.compare());
    addEventListener("beforeunload", (event) => {
      if (this.saving === "saved") return;
      this.save(true);
      event.preventDefault();
    });
  }

  // one edit: section 'video', 'photo' or 'reviewed', its key, where the user was; then changes; then commit
  begin(section, key, where) {
    this.begun = { section, key, where, before: copy(this.doc[section][key]) };
  }

  put(section, key, value) {
    const empty = value === undefined || (!Array.isArray(value) && Object.keys(value).length === 0);
    if (empty) delete this.doc[section][key];
    else this.doc[section][key] = value;
    this.told("edit");
  }

  commit(label = "") {
    const edit = this.begun;
    this.begun = null;
    if (!edit) return;
    edit.after = copy(this.doc[edit.section][edit.key]);
    if (same(edit.before, edit.after)) return;
    const last = this.done.at(-1);
    const now = performance.now();
    if (label && last?.label === label && now - last.when < SAME_NUDGE && last.key === edit.key) {
      last.after = edit.after;
      last.when = now;
    } else {
      this.done.push({ ...edit, label, when: now });
    }
    this.undone = [];
    this.changed();
  }

  cancel() {
    if (!this.begun) return;
    const { section, key, before } = this.begun;
    this.begun = null;
    this.put(section, key, before);
  }

  undo() {
    return this.step(this.done, this.undone, "before");
  }

  redo() {
    return this.step(this.undone, this.done, "after");
  }

  step(from, to, side) {
    this.cancel();
    const edit = from.pop();
    if (!edit) return null;
    to.push(edit);
    edit.label = "";
    this.put(edit.section, edit.key, copy(edit[side]));
    this.changed();
    return edit.where;
  }

  content() {
    const { video, photo, reviewed } = this.doc;
    const content = {
      version: 1,
      video: mapped(video, (points) => mapped(points, (at) => moved(at, -CENTRE))),
      photo: mapped(photo, (lines) => mapped(lines, (line) => line.map((at) => moved(at, -CENTRE)))),
    };
    if (reviewed.list?.length) content.reviewed = reviewed.list;
    return content;
  }

  changed() {
    this.version += 1;
    if (this.saving === "conflict") return;
    if (this.saving !== "saving") this.tell("unsaved");
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.save(), PAUSE);
    this.told("edit");
  }

  // the user comes back to the page: has a run ended, or somebody else changed the file?
  async compare() {
    if (this.saving !== "saved") return;
    const { version } = this;
    try {
      const answer = await fetch("freshness");
      const said = await answer.json();
      if (this.saving !== "saved" || version !== this.version) return;
      if (!answer.ok || said.tag !== this.tag) {
        this.fault = said.fault ?? "corrections.json has been changed elsewhere: load the page again";
        this.tell("conflict");
        return;
      }
      this.stale = said.stale;
      this.tell("saved");
    } catch {
      // the next saving tells that the program does not answer
    }
  }

  async save(leaving = false) {
    if (this.saving === "saving" || this.saving === "conflict") return;
    clearTimeout(this.timer);
    const version = this.version;
    this.tell("saving");
    try {
      const answer = await fetch("corrections", {
        method: "PUT",
        headers: { "Content-Type": "application/json", "If-Match": this.tag },
        body: JSON.stringify(this.content()),
        keepalive: leaving,
      });
      const said = await answer.json();
      if (answer.status === 409) {
        this.fault = said.fault;
        this.tell("conflict");
        return;
      }
      if (!answer.ok) throw new Error(said.fault);
      this.tag = said.tag;
      this.stale = said.stale;
      this.fault = "";
      this.tell(version === this.version ? "saved" : "unsaved");
      if (version !== this.version) this.timer = setTimeout(() => this.save(), PAUSE);
    } catch (error) {
      this.fault = error instanceof TypeError ? "the program does not answer: is it still running?" : error.message;
      this.tell("fault");
      this.timer = setTimeout(() => this.save(), AGAIN);
    }
  }

  tell(state) {
    this.saving = state;
    this.told(state === "conflict" ? "conflict" : "saving");
  }
}
