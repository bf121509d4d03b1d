// Keys of the page: rows [key, what it does, action or null], digits by number; and the list of them.

export function keysIn({ dialog, list }, rows, digit) {
  for (const [key, text] of rows)
    list.append(Object.assign(document.createElement("dt"), { textContent: key.replace("Arrow", "") }),
                Object.assign(document.createElement("dd"), { textContent: text }));
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || dialog.open) return;
    // what a focused control does with a key stays its own
    const own = event.target.closest?.("input, select, textarea, button, summary");
    const sliding = own?.matches("input[type=range], select");
    if (event.key.startsWith("Arrow") && sliding) return;
    if (event.key === " " && own && !sliding) return;
    if (own?.matches("select, input:not([type=range], [type=checkbox])")) return;
    if (/^[0-9]$/.test(event.key)) {
      digit(Number(event.key));
      return;
    }
    const wanted = event.key === " " ? "Space" : event.key.length === 1 ? event.key.toUpperCase() : event.key;
    const found = rows.find(([key, , action]) => key === wanted && action);
    if (!found) return;
    event.preventDefault();
    found[2]();
  });
}
