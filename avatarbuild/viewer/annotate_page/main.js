// The page: tabs, list of frames, keys, buttons.

import { FramesMode } from "./frames.js";
import { PhotoMode } from "./photo.js";
import { Pictures } from "./pictures.js";
import { Store } from "./store.js";
import { COLOURS, View, bare, paint, symbol } from "./view.js";

const KEYS = [
  ["N", "the worst frame that nobody has looked at"],
  ["Enter", "this frame is good; on to the worst of the others"],
  [", .  Page Up, Page Down", "frame before, frame after"],
  ["arrow keys", "nudge the chosen point by half a pixel; with Shift by five"],
  ["[ ]", "point before, point after"],
  ["Delete", "delete the chosen point's correction; with Shift all of this picture"],
  ["K", "keep the carried points of this frame as if set by hand"],
  ["Ctrl+Z, Ctrl+Shift+Z", "undo, redo"],
  ["1, 2, 3", "a drag moves one point, its neighbours softly, the whole part (also: hold Shift)"],
  ["+, −, wheel, pinch", "zoom"],
  ["F, E, M, W", "the face, the eyes, the mouth, the whole picture"],
  ["Space and drag", "move the picture (so does a drag beside the points)"],
  ["R, L, H", "reference lines, loupe, hide the points while held"],
  ["P, V", "frontal photo, video frames"],
  ["Esc", "stop a drag, choose nothing"],
];
const NEARBY = [-2, -1, 0, 1, 2];
const NUDGE = 0.5; // pixels
const find = (id) => document.getElementById(id);
const each = (selector, action) => document.querySelectorAll(selector).forEach(action);

const page = { modes: {}, mode: null, store: null, view: null, order: "worst", items: new Map(), part: "face" };

globalThis.annotate = page; // for the browser's console, and for tests

boot().catch((error) => {
  find("empty").hidden = false;
  find("empty").textContent = `The page cannot be shown: ${error.message}`;
});

async function boot() {
  const answer = await fetch("state");
  const state = await answer.json();
  if (!answer.ok) throw new Error(state.fault);
  document.title = `${state.project} – annotate`;
  find("project").textContent = state.project;
  page.notes = state.notes;
  page.store = new Store(state, told);
  const pictures = new Pictures(60, redraw);
  page.pictures = pictures;
  page.view = new View(find("picture"), pictures, dragged);
  if (state.photo) page.modes.photo = new PhotoMode(state.photo, page.store);
  if (state.video) page.modes.frames = new FramesMode(state.video, page.store, state.live, carried);
  if (page.modes.frames) listFrames();
  legend();
  buttons();
  show(page.modes.photo ? "photo" : "frames");
  told("saving");
  document.documentElement.dataset.ready = "true";
}

// what is shown

function show(tab) {
  const mode = page.modes[tab] ?? null;
  each("#tabs button", (button) => button.setAttribute("aria-selected", String(button.dataset.tab === tab)));
  page.tab = tab;
  page.mode = page.view.mode = mode;
  page.view.selected = page.view.hovered = null;
  find("empty").hidden = mode !== null;
  find("empty").textContent = mode ? "" : page.notes[tab === "photo" ? "photo" : "video"];
  for (const [id, tabs] of [["list", "frames"], ["nearby", "frames"], ["walk", "frames"], ["keep", "frames"], ["basis", "photo"]]) {
    find(id).hidden = mode === null || tabs !== tab;
  }
  find("basis").hidden ||= !mode?.fitted;
  if (mode) {
    find("reference-name").textContent = tab === "photo" ? "Dashed: where it started" : "Dashed: the tracked head";
    find("show-reference").checked = mode.reference;
    page.part = "face";
    page.view.fit(mode.part(page.part));
  }
  if (tab === "frames" && mode) openFrame(mode.frame);
  refresh();
}

function openFrame(frame) {
  const mode = page.modes.frames;
  if (frame === null || !mode) return;
  mode.open(frame);
  if (page.view.wanted) page.view.fit(mode.part(page.part));
  const item = page.items.get(frame);
  each("#frames [aria-current]", (old) => old.removeAttribute("aria-current"));
  each("#frames button[aria-pressed]", (old) => old.removeAttribute("aria-pressed"));
  item?.setAttribute("aria-pressed", "true");
  item?.scrollIntoView({ block: "nearest", inline: "nearest" });
  for (const step of [1, -1]) {
    const beside = mode.beside(step);
    if (beside !== null) page.pictures.get(`picture/frame/${beside}/face`);
  }
  const next = mode.nextWorst();
  if (next !== null) page.pictures.get(`picture/frame/${next}/face`);
  refresh();
}

function look(part) {
  if (!page.mode) return;
  page.part = part;
  page.view.fit(page.mode.part(part));
  if (page.tab === "frames") nearby();
}

function told(what) {
  const { store } = page;
  if (!store) return;
  if (what === "conflict") {
    find("conflict-text").textContent = store.fault;
    if (!find("conflict").open) find("conflict").showModal();
  }
  const words = { saved: "Saved", unsaved: "Not saved yet", saving: "Saving …", fault: "Not saved", conflict: "Not saved" };
  const saving = find("saving");
  saving.dataset.state = store.saving === "conflict" ? "fault" : store.saving;
  saving.textContent = words[store.saving];
  saving.title = store.fault;
  const stale = store.stale;
  find("next").textContent = store.fault
    ? `Not saved: ${store.fault}`
    : stale.length
      ? `The next avatarbuild run redoes ${stale.length > 1 ? `${stale[0]} and what follows (${stale.length} stages)` : stale[0]}.`
      : "Everything is up to date: the next run has nothing to redo.";
  if (what === "edit") refresh();
}

function carried() {
  if (page.tab === "frames" && page.mode) refresh();
}

function redraw() {
  page.view?.redraw();
  if (page.tab === "frames" && page.mode) nearby();
}

function refresh() {
  const { mode, view, store } = page;
  view.redraw();
  find("undo").disabled = !store.done.length;
  find("redo").disabled = !store.undone.length;
  if (!mode) return;
  find("title").textContent = mode.title() + (view.selected === null ? "" : ` · ${mode.label(view.selected)}`);
  find("facts").textContent = mode.facts();
  const chosen = view.selected;
  const handle = chosen === null ? null : mode.handles().find((one) => one.id === chosen);
  find("remove").disabled = handle?.kind !== "corrected";
  find("clear").disabled = page.tab === "photo" ? mode.count() === 0 : !store.doc.video[mode.frame];
  each("[data-pull]", (button) => button.setAttribute("aria-pressed", String(button.dataset.pull === mode.pull)));
  each("[data-base]", (button) => button.setAttribute("aria-pressed", String(button.dataset.base === mode.base)));
  const frames = page.modes.frames;
  const done = frames ? frames.frames.filter((row) => frames.reviewed().includes(row.frame)).length : 0;
  find("progress").textContent = frames
    ? `${done} of ${frames.frames.length} frames reviewed, ${frames.count()} corrected`
    : "";
  const note = find("note");
  note.hidden = true;
  if (page.tab === "frames") {
    const busy = mode.live && mode.ready < 1 && mode.count() > 0;
    note.textContent = busy
      ? `Flow about this frame: ${Math.floor(100 * mode.ready)} %`
      : mode.fault || (page.notes.flow ?? "");
    note.hidden = !note.textContent;
    find("keep").disabled = !mode.handles().some((one) => one.kind === "carried");
    find("before").disabled = mode.beside(-1) === null;
    find("after").disabled = mode.beside(1) === null;
    marks();
    nearby();
  }
}

// the list of frames

function listFrames() {
  const mode = page.modes.frames;
  for (const row of mode.frames) {
    const item = document.createElement("button");
    item.dataset.frame = row.frame;
    const worth = row.found ? (row.worth ?? 0) : 0;
    item.innerHTML =
      `<img alt="" loading="lazy" src="picture/frame/${row.frame}/thumb"><span>${row.frame} ` +
      `<span class="when">${row.time.toFixed(1)} s</span></span><span class="mark"></span>` +
      `<span class="bar"><i style="width:${Math.max(4, 100 * worth)}%;background:hsl(${120 * worth} 60% 50%)"></i></span>`;
    item.title = row.found ? `worth ${worth.toFixed(2)}` : "no face was found";
    item.addEventListener("click", () => openFrame(row.frame));
    page.items.set(row.frame, item);
  }
  sortFrames();
}

function sortFrames() {
  const mode = page.modes.frames;
  const order = page.order === "worst" ? mode.worst : mode.frames.map((row) => row.frame);
  find("frames").replaceChildren(
    ...order.map((frame) => {
      const line = document.createElement("li");
      line.append(page.items.get(frame));
      return line;
    }),
  );
  each("#order button", (button) => button.setAttribute("aria-pressed", String(button.dataset.order === page.order)));
}

function marks() {
  const mode = page.modes.frames;
  const done = new Set(mode.reviewed());
  for (const [frame, item] of page.items) {
    const state = mode.state(frame);
    const mark = item.querySelector(".mark");
    const text = done.has(frame) ? "✓" : state === "corrected" ? "●" : state === "carried" ? "◆" : "";
    if (mark.textContent !== text) mark.textContent = text;
    mark.style.color = state === "detected" ? "" : COLOURS[state];
  }
}

// the frames beside this one, small

function nearby() {
  const mode = page.modes.frames;
  const strip = find("nearby");
  if (!strip.children.length) {
    for (const _ of NEARBY) {
      const button = document.createElement("button");
      button.innerHTML = "<canvas></canvas><span></span>";
      button.addEventListener("click", () => button.dataset.frame && openFrame(Number(button.dataset.frame)));
      strip.append(button);
    }
  }
  NEARBY.forEach((step, i) => {
    const button = strip.children[i];
    const frame = mode.beside(step);
    button.style.visibility = frame === null ? "hidden" : "";
    button.classList.toggle("here", step === 0);
    if (frame === null) return;
    button.dataset.frame = frame;
    const canvas = button.firstChild;
    const [w, h] = [canvas.clientWidth, canvas.clientHeight];
    if (!w) return;
    const ratio = devicePixelRatio || 1;
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
    const there = mode.of(frame);
    const [l, t, r, b] = there.part(page.part === "whole" ? "face" : page.part);
    const scale = Math.min(w / (r - l), h / (b - t));
    const origin = [(l + r) / 2 - w / 2 / scale, (t + b) / 2 - h / 2 / scale];
    const small = { pictures: () => there.pictures().slice(1), lines: () => [], handles: () => there.handles() };
    paint(canvas.getContext("2d"), small, page.pictures, scale, origin, ratio, null, Math.min(0.42 + 0.2 * scale, 0.8));
    button.lastChild.textContent = step === 0 ? "this frame" : `${frame} · ${there.row.time.toFixed(1)} s`;
  });
}

function legend() {
  const rows = [
    ["corrected", "set by hand"],
    ["carried", "carried here by the flow"],
    ["detected", "the detector's"],
    ["fit", "the fitted head's"],
  ];
  for (const [kind, words] of rows) {
    const row = document.createElement("div");
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = 40;
    const context = canvas.getContext("2d");
    context.scale(2, 2);
    symbol(context, kind, 10, 10);
    row.append(canvas, words);
    find("legend").append(row);
  }
}

// dragging

function dragged(what, detail) {
  const { mode, store, view } = page;
  if (what === "grab") {
    mode.begin();
    const shares = mode.shares(detail.id, detail.shift ? "part" : mode.pull);
    const places = new Map(mode.handles().map((handle) => [handle.id, handle.at]));
    page.drag = [...shares].map(([id, share]) => [id, share, places.get(id)]).filter(([, , at]) => at);
  } else if (what === "move" && page.drag) {
    place(page.drag.map(([id, share, at]) => [id, [at[0] + share * detail.by[0], at[1] + share * detail.by[1]]]));
  } else if (what === "drop") {
    page.drag = null;
    store.commit();
  } else if (what === "cancel") {
    page.drag = null;
    store.cancel();
  }
  if (what === "grab" || what === "select") refresh();
  view.redraw();
}

function place(moves) {
  const [w, h] = page.mode.size;
  const within = ([x, y]) => [Math.min(Math.max(x, 0), w), Math.min(Math.max(y, 0), h)];
  page.mode.set(new Map(moves.map(([id, at]) => [id, within(at)])));
}

function nudge(dx, dy) {
  const { mode, view, store } = page;
  const handle = mode?.handles().find((one) => one.id === view.selected);
  if (!handle) return;
  mode.begin();
  place([[handle.id, [handle.at[0] + dx, handle.at[1] + dy]]]);
  store.commit(`nudge ${handle.id}`);
}

function choose(step) {
  const { mode, view } = page;
  const ids = mode.handles().map((handle) => handle.id);
  if (!ids.length) return;
  const i = ids.indexOf(view.selected);
  view.select(ids[(i + step + ids.length) % ids.length]);
}

function back(where) {
  if (!where) return;
  if (where.tab !== page.tab) show(where.tab);
  if (where.tab === "frames" && where.frame !== page.mode.frame) openFrame(where.frame);
  else if (where.tab === "frames") page.mode.ask();
  refresh();
}

function accept() {
  const mode = page.modes.frames;
  const { frame } = mode;
  const next = mode.nextWorst();
  mode.review(frame, true);
  if (next !== null) openFrame(next);
}

function remove(all) {
  const { mode, view } = page;
  if (all) mode.clear();
  else if (view.selected !== null && !find("remove").disabled) mode.remove(view.selected);
}

// buttons and keys

function buttons() {
  const { view, store } = page;
  each("#tabs button", (button) => button.addEventListener("click", () => show(button.dataset.tab)));
  each("#order button", (button) =>
    button.addEventListener("click", () => {
      page.order = button.dataset.order;
      sortFrames();
    }),
  );
  each("[data-pull]", (button) =>
    button.addEventListener("click", () => {
      page.mode.pull = button.dataset.pull;
      refresh();
    }),
  );
  each("[data-base]", (button) =>
    button.addEventListener("click", () => {
      page.mode.base = button.dataset.base;
      refresh();
    }),
  );
  const zooms = { in: 1.4, out: 1 / 1.4 };
  each("[data-zoom]", (button) => button.addEventListener("click", () => view.zoom(zooms[button.dataset.zoom])));
  each("[data-part]", (button) => button.addEventListener("click", () => look(button.dataset.part)));
  const clicks = {
    undo: () => back(store.undo()),
    redo: () => back(store.redo()),
    accept,
    before: () => openFrame(page.mode.beside(-1)),
    after: () => openFrame(page.mode.beside(1)),
    remove: () => remove(false),
    clear: () => remove(true),
    keep: () => page.mode.keep(),
    help: () => find("keys").showModal(),
  };
  for (const [id, action] of Object.entries(clicks)) find(id).addEventListener("click", action);
  find("saving").addEventListener("click", () => store.save());
  find("show-reference").addEventListener("change", (event) => {
    page.mode.reference = event.target.checked;
    view.redraw();
  });
  find("show-loupe").addEventListener("change", (event) => (view.loupe = event.target.checked));
  find("conflict").addEventListener("close", () => {
    if (find("conflict").returnValue !== "reload") return;
    store.saving = "saved";
    location.reload();
  });
  find("keytable").innerHTML = KEYS.map(([key, what]) => `<tr><td><kbd>${key}</kbd></td><td>${what}</td></tr>`).join("");
  addEventListener("keydown", pressed);
  addEventListener("keyup", released);
  addEventListener("blur", () => released({ key: " " }));
}

function pressed(event) {
  if (document.querySelector("dialog[open]") || !page.mode) return;
  const { view, store } = page;
  const { key } = event;
  const control = event.ctrlKey || event.metaKey;
  const onButton = event.target instanceof HTMLElement && event.target.matches("button, input") && ["Enter", " "].includes(key);
  if (onButton) return;
  const frames = page.tab === "frames" ? page.mode : null;
  const step = NUDGE * (event.shiftKey ? 10 : 1);
  const actions = {
    ArrowLeft: () => nudge(-step, 0),
    ArrowRight: () => nudge(step, 0),
    ArrowUp: () => nudge(0, -step),
    ArrowDown: () => nudge(0, step),
    "[": () => choose(-1),
    "]": () => choose(1),
    Delete: () => remove(event.shiftKey),
    Backspace: () => remove(event.shiftKey),
    "+": () => view.zoom(1.25),
    "=": () => view.zoom(1.25),
    "-": () => view.zoom(1 / 1.25),
    f: () => look("face"),
    e: () => look("eyes"),
    m: () => look("mouth"),
    w: () => look("whole"),
    " ": () => hold(true),
    r: () => find("show-reference").click(),
    l: () => find("show-loupe").click(),
    p: () => show("photo"),
    v: () => show("frames"),
    1: () => document.querySelector("[data-pull=point]").click(),
    2: () => document.querySelector("[data-pull=soft]").click(),
    3: () => document.querySelector("[data-pull=part]").click(),
    "?": () => find("keys").showModal(),
    h: () => hide(true),
    Escape: () => escape(),
    ...(frames && {
      ",": () => openFrame(frames.beside(-1)),
      ".": () => openFrame(frames.beside(1)),
      PageUp: () => openFrame(frames.beside(-1)),
      PageDown: () => openFrame(frames.beside(1)),
      n: () => openFrame(frames.nextWorst()),
      k: () => frames.keep(),
      Enter: accept,
    }),
  };
  const name = key.length === 1 ? key.toLowerCase() : key;
  let action = actions[name];
  if (control) {
    action = { z: () => back(event.shiftKey ? store.redo() : store.undo()), y: () => back(store.redo()), s: () => store.save() }[name];
  }
  if (!action || event.altKey) return;
  event.preventDefault();
  action();
}

function released(event) {
  if (event.key === " ") hold(false);
  if (event.key === "h" || event.key === "H") hide(false);
}

function hold(space) {
  page.view.space = space;
  page.view.cursor();
}

function hide(hidden) {
  const { view, mode } = page;
  view.mode = hidden ? bare(mode, false) : mode;
  view.redraw();
}

function escape() {
  if (page.drag) {
    page.drag = null;
    page.view.action = null;
    page.store.cancel();
  } else {
    page.view.select(null);
  }
}
