// Sliders of the 52 shapes, in groups; mirrored pairs move together while they are linked.
import { GROUPS, INDEX, NAMES } from "./shapes.js";

export function slidersIn(place, link, evidence, changed) {
  const inputs = new Array(NAMES.length), outputs = new Array(NAMES.length), partners = new Map();
  const weights = new Float32Array(NAMES.length);

  const show = (j) => {
    inputs[j].value = weights[j];
    inputs[j].style.setProperty("--at", `${100 * weights[j]}%`);
    const text = weights[j] > 0 ? weights[j].toFixed(2).replace(/^0/, "") : "";
    if (outputs[j].value !== text) outputs[j].value = text;
  };
  const move = (j, value) => {
    weights[j] = value;
    const other = partners.get(j);
    if (link.checked && other !== undefined) { weights[other] = value; show(other); }
    show(j);
    changed(weights);
  };

  for (const group of GROUPS) {
    const box = document.createElement("details");
    box.className = "group";
    box.open = group.title !== "Tongue";
    box.innerHTML = "<summary></summary>";
    box.firstChild.textContent = group.title;
    if (group.rows.some((row) => row.names.length === 2)) {
      const sides = document.createElement("div");
      sides.className = "sides";
      sides.innerHTML = "<span></span><span>subject's left</span><span>right</span>";
      box.append(sides);
    }
    for (const row of group.rows) {
      const line = document.createElement("div");
      line.className = row.names.length === 2 ? "slider" : "slider one";
      const name = document.createElement("span");
      name.className = "name";
      name.textContent = row.title;
      const known = row.names.map((shape) => evidence?.[shape]).filter((v) => v !== undefined);
      name.title = row.names.join(", ") + (known.length ? `\nevidence of the video: ${known.map((v) => v.toFixed(2)).join(", ")}` : "");
      line.append(name);
      for (const shape of row.names) {
        const j = INDEX[shape], cell = document.createElement("div");
        cell.className = "cell";
        const input = Object.assign(document.createElement("input"), { type: "range", min: 0, max: 1, step: 0.01, value: 0 });
        input.dataset.shape = shape;
        input.setAttribute("aria-label", shape);
        input.title = `${shape} (double click: nil)`;
        input.addEventListener("input", () => move(j, Number(input.value)));
        input.addEventListener("dblclick", () => move(j, 0));
        const output = document.createElement("output");
        inputs[j] = input;
        outputs[j] = output;
        cell.append(input, output);
        line.append(cell);
      }
      if (row.names.length === 2) {
        const [a, b] = row.names.map((shape) => INDEX[shape]);
        partners.set(a, b).set(b, a);
      }
      box.append(line);
    }
    place.append(box);
  }

  return {
    // shows weights without telling anybody
    show(values) {
      for (let j = 0; j < weights.length; j++)
        if (weights[j] !== values[j]) { weights[j] = values[j]; show(j); }
    },
  };
}

// A row of buttons that stay pressed: [{ key, title, hint, on, disabled }]; press(key) as if it were clicked.
export function togglesIn(place, rows, changed) {
  const buttons = new Map();
  for (const row of rows) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = row.title;
    button.title = row.hint;
    button.disabled = Boolean(row.disabled);
    button.dataset.toggle = row.key;
    button.setAttribute("aria-pressed", String(row.on));
    button.addEventListener("click", () => set(row.key, button.getAttribute("aria-pressed") !== "true"));
    buttons.set(row.key, button);
    place.append(button);
  }
  function set(key, on) {
    const button = buttons.get(key);
    if (button.disabled) return;
    button.setAttribute("aria-pressed", String(on));
    changed(key, on);
  }
  return {
    set,
    press: (key) => buttons.get(key)?.click(),
    on: (key) => buttons.get(key)?.getAttribute("aria-pressed") === "true",
  };
}
