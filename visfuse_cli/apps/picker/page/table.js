// The marks as a table: what can be typed, what the fit says of each.
const HEADS = {
  point: ["", "u px", "v px", "X m", "Y m", "off px", "off m", "w/o m", ""],
  line: ["", "X1 m", "Y1 m", "X2 m", "Y2 m", "off px", "off m", "w/o m", ""],
};

const TITLES = { "off px": "how far the fit misses it in the picture", "off m": "how far on the ground", "w/o m": "how far the fit to the others misses it" };

export class Table {
  #sheet; #table; #noun = null;

  constructor(table, sheet) {
    this.#table = table; this.#sheet = sheet;
    table.addEventListener("input", event => this.#typed(event.target));
    table.addEventListener("focusin", event => {
      const row = event.target.closest("tbody tr");
      if (row && row.rowIndex - 1 !== sheet.chosen) sheet.choose(row.rowIndex - 1);
    });
    table.addEventListener("click", event => { if (event.target.matches("button")) sheet.remove(event.target.closest("tr").rowIndex - 1); });
    sheet.addEventListener("change", () => this.#render());
    sheet.addEventListener("choose", () => this.#highlight());
    sheet.addEventListener("fit", () => this.#judge());
  }

  #fields() { // of one row: which list it writes to, the place in it
    const world = Array.from({ length: this.#sheet.noun === "point" ? 2 : 4 }, (_, k) => ["world", k]);
    return this.#sheet.noun === "point" ? [["at", 0], ["at", 1], ...world] : world;
  }

  #typed(input) {
    const row = input.closest("tr").rowIndex - 1, [list, place] = this.#fields()[input.dataset.field];
    const value = input.value.trim() === "" ? null : Number(input.value);
    this.#sheet.marks[row][list][place] = Number.isFinite(value) ? value : null;
    if (list === "at" && value === null) return;
    this.#sheet.changed();
  }

  #render() {
    const { noun, marks } = this.#sheet, body = this.#table.tBodies[0];
    if (noun !== this.#noun) {
      this.#noun = noun; body.replaceChildren();
      this.#table.classList.toggle("lines", noun === "line");
      const head = document.createElement("tr");
      for (const name of HEADS[noun]) { const cell = document.createElement("th"); cell.scope = "col"; cell.textContent = name; cell.title = TITLES[name] ?? ""; head.append(cell); }
      this.#table.tHead.replaceChildren(head);
    }
    while (body.rows.length > marks.length) body.deleteRow(-1);
    while (body.rows.length < marks.length) body.append(this.#row());
    [...body.rows].forEach((row, k) => this.#fill(row, k));
    this.#highlight();
  }

  #row() {
    const row = document.createElement("tr"), cell = () => { const made = document.createElement("td"); row.append(made); return made; };
    cell();
    this.#fields().forEach((_, k) => {
      const input = document.createElement("input");
      input.type = "number"; input.step = "any"; input.dataset.field = k;
      cell().append(input);
    });
    cell(); cell(); cell();
    const remove = document.createElement("button");
    remove.type = "button"; remove.textContent = "\u00d7";
    cell().append(remove);
    return row;
  }

  #fill(row, k) {
    const { noun, marks, patterned } = this.#sheet, names = HEADS[noun];
    row.cells[0].textContent = k + 1;
    row.querySelector("button").setAttribute("aria-label", `remove ${noun} ${k + 1}`);
    row.querySelectorAll("input").forEach((input, field) => {
      const [list, place] = this.#fields()[field], value = marks[k][list][place];
      input.setAttribute("aria-label", `${noun} ${k + 1}, ${names[field + 1]}`);
      input.readOnly = list === "world" && k < patterned;
      if (input !== document.activeElement && !input.readOnly) input.value = value === null ? "" : list === "at" ? Number(value.toFixed(2)) : value;
    });
  }

  #highlight() {
    [...this.#table.tBodies[0].rows].forEach((row, k) => row.classList.toggle("chosen", k === this.#sheet.chosen));
  }

  #judge() {
    const { fit, noun } = this.#sheet, first = 1 + this.#fields().length;
    [...this.#table.tBodies[0].rows].forEach((row, k) => {
      const told = fit.fits ? fit.residuals[k] : null, shown = (value, digits) => Number.isFinite(value) ? value.toFixed(digits) : "";
      row.cells[first].textContent = shown(told?.error_px, 2);
      row.cells[first + 1].textContent = shown(told?.error_m, 3);
      row.cells[first + 2].textContent = shown(told?.leave_one_out_m, 2);
      row.classList.toggle("dropped", told !== null && !told?.used);
      row.querySelectorAll("input").forEach((input, field) => {
        const [list, place] = this.#fields()[field];
        if (list === "world" && input.readOnly && noun === "point") input.value = fit.world?.[k]?.[place] ?? "";
      });
    });
  }
}
