// The 52 shapes: their order, groups of sliders, mirrored pairs, presets, and tables of weights.

export const NAMES = (
  "eyeBlinkLeft eyeLookDownLeft eyeLookInLeft eyeLookOutLeft eyeLookUpLeft eyeSquintLeft eyeWideLeft eyeBlinkRight " +
  "eyeLookDownRight eyeLookInRight eyeLookOutRight eyeLookUpRight eyeSquintRight eyeWideRight jawForward jawLeft " +
  "jawRight jawOpen mouthClose mouthFunnel mouthPucker mouthLeft mouthRight mouthSmileLeft mouthSmileRight " +
  "mouthFrownLeft mouthFrownRight mouthDimpleLeft mouthDimpleRight mouthStretchLeft mouthStretchRight mouthRollLower " +
  "mouthRollUpper mouthShrugLower mouthShrugUpper mouthPressLeft mouthPressRight mouthLowerDownLeft " +
  "mouthLowerDownRight mouthUpperUpLeft mouthUpperUpRight browDownLeft browDownRight browInnerUp browOuterUpLeft " +
  "browOuterUpRight cheekPuff cheekSquintLeft cheekSquintRight noseSneerLeft noseSneerRight tongueOut"
).split(" ");

export const INDEX = Object.fromEntries(NAMES.map((name, j) => [name, j]));

const pair = (title, stem) => ({ title, names: [`${stem}Left`, `${stem}Right`] });
const one = (title, name) => ({ title, names: [name] });

// A pair is [the subject's left, right]. Gaze pairs turn both eyes the same way, so they cross the names In and Out.
export const GROUPS = [
  { title: "Brows", rows: [pair("Down", "browDown"), one("Inner up", "browInnerUp"), pair("Outer up", "browOuterUp")] },
  {
    title: "Eyes",
    rows: [
      pair("Blink", "eyeBlink"), pair("Squint", "eyeSquint"), pair("Wide", "eyeWide"),
      pair("Look up", "eyeLookUp"), pair("Look down", "eyeLookDown"),
      { title: "Look left", names: ["eyeLookOutLeft", "eyeLookInRight"] },
      { title: "Look right", names: ["eyeLookInLeft", "eyeLookOutRight"] },
    ],
  },
  {
    title: "Cheeks and nose",
    rows: [one("Puff", "cheekPuff"), pair("Squint", "cheekSquint"), pair("Sneer", "noseSneer")],
  },
  {
    title: "Jaw",
    rows: [one("Open", "jawOpen"), one("Forward", "jawForward"), one("Left", "jawLeft"), one("Right", "jawRight")],
  },
  {
    title: "Mouth",
    rows: [
      pair("Smile", "mouthSmile"), pair("Frown", "mouthFrown"), pair("Dimple", "mouthDimple"),
      pair("Stretch", "mouthStretch"), pair("Press", "mouthPress"), pair("Upper up", "mouthUpperUp"),
      pair("Lower down", "mouthLowerDown"), one("Close", "mouthClose"), one("Funnel", "mouthFunnel"),
      one("Pucker", "mouthPucker"), one("Left", "mouthLeft"), one("Right", "mouthRight"),
      one("Roll upper", "mouthRollUpper"), one("Roll lower", "mouthRollLower"),
      one("Shrug upper", "mouthShrugUpper"), one("Shrug lower", "mouthShrugLower"),
    ],
  },
  { title: "Tongue", rows: [one("Out", "tongueOut")] },
];

const both = (stem, value) => ({ [`${stem}Left`]: value, [`${stem}Right`]: value });

export const PRESETS = [
  { title: "Neutral", weights: {} },
  {
    title: "Smile",
    weights: { ...both("mouthSmile", 0.9), ...both("cheekSquint", 0.6), ...both("eyeSquint", 0.3), ...both("mouthUpperUp", 0.25), jawOpen: 0.08 },
  },
  { title: "Frown", weights: { ...both("browDown", 1), ...both("mouthFrown", 0.6), ...both("noseSneer", 0.35), ...both("eyeSquint", 0.35) } },
  {
    title: "Surprise",
    weights: { browInnerUp: 0.9, ...both("browOuterUp", 1), ...both("eyeWide", 0.8), jawOpen: 0.4, mouthFunnel: 0.2 },
  },
  { title: "Blink", weights: both("eyeBlink", 1) },
  { title: "Open", weights: { jawOpen: 0.8, ...both("mouthLowerDown", 0.2) } },
  { title: "Pucker", weights: { mouthPucker: 1 } },
  { title: "Puff", weights: { cheekPuff: 1, ...both("mouthPress", 0.3) } },
  { title: "Sneer", weights: { ...both("noseSneer", 1), ...both("mouthUpperUp", 0.6), ...both("browDown", 0.5) } },
];

export function weightsOf(named) {
  const out = new Float32Array(NAMES.length);
  for (const [name, value] of Object.entries(named)) if (name in INDEX) out[INDEX[name]] = value;
  return out;
}

// Cells of a CSV table; quotes as in RFC 4180.
function cells(text) {
  const rows = [];
  let row = [], cell = "", quoted = false;
  for (let i = 0; i < text.length; i++) {
    const c = text[i];
    if (quoted) {
      if (c === '"' && text[i + 1] === '"') { cell += '"'; i++; }
      else if (c === '"') quoted = false;
      else cell += c;
    } else if (c === '"') quoted = true;
    else if (c === ",") { row.push(cell); cell = ""; }
    else if (c === "\n" || c === "\r") {
      if (c === "\r" && text[i + 1] === "\n") i++;
      row.push(cell); rows.push(row); row = []; cell = "";
    } else cell += c;
  }
  row.push(cell);
  rows.push(row);
  return rows.filter((r) => r.some((value) => value.trim()));
}

// Seconds of hh:mm:ss:ff.mmm; null for anything else. NaN frames a second: what Timecode cannot tell.
function seconds(timecode, fps) {
  const parts = /^(\d+):(\d+):(\d+):(\d+(?:\.\d+)?)$/.exec((timecode ?? "").trim());
  return parts ? 3600 * +parts[1] + 60 * +parts[2] + +parts[3] + +parts[4] / fps : null;
}

// The rule of `avatarbuild animate`: a header with the shapes' names in any order and case, a line a frame; HeadYaw,
// HeadPitch and HeadRoll are read where all three are there. Throws an Error that says what is wrong.
export function readTable(text, name, fps = 30) {
  const rows = cells(text.replace(/^\ufeff/, ""));
  const header = (rows[0] ?? []).map((cell) => cell.trim().toLowerCase());
  const columns = NAMES.map((shape) => header.indexOf(shape.toLowerCase()));
  if (columns.every((column) => column < 0))
    throw new Error(`${name}: no column of its first line is an ARKit shape such as JawOpen`);
  if (rows.length < 2) throw new Error(`${name}: holds no frame`);
  const angles = ["headyaw", "headpitch", "headroll"].map((angle) => header.indexOf(angle));
  const number = (row, column, i) => {
    const value = (row[column] ?? "").trim() === "" ? NaN : Number(row[column]);
    if (!Number.isFinite(value)) throw new Error(`${name}: frame ${i + 1}, column ${rows[0][column]} holds '${row[column] ?? ""}'`);
    return value;
  };
  const frames = rows.slice(1);
  const weights = frames.map((row, i) => Float32Array.from(columns, (c) => (c < 0 ? 0 : Math.min(Math.max(number(row, c, i), 0), 1))));
  const head = angles.some((column) => column < 0) ? null : frames.map((row, i) => angles.map((c) => number(row, c, i)));
  const clock = header.indexOf("timecode");
  let times = clock < 0 ? [] : frames.map((row) => seconds(row[clock], fps));
  const sound = times.length > 0 && times.every((time, i) => time !== null && (i === 0 || time > times[i - 1]));
  times = sound ? times.map((time) => time - times[0]) : frames.map((_, i) => i / fps);
  return { name, times, weights, head, poses: null, quality: null };
}
