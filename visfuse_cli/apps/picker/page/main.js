// Ties the frame, the sheet and the forms together.
import { Sheet, post } from "./sheet.js";
import { Table } from "./table.js";
import { View } from "./view.js";

const $ = id => document.getElementById(id);
const sheet = new Sheet(), view = new View($("view"), sheet);
new Table($("table"), sheet);
let about = null, wanted = 0, last = null;

async function showFrame(t) {
  const number = ++wanted, answer = await fetch(`frame?t=${t}`).catch(() => null);
  if (!answer?.ok) { $("verdict").textContent = answer ? (await answer.json()).reason : "the tool has ended; start it again"; return; }
  const image = await createImageBitmap(await answer.blob());
  if (number !== wanted) return;
  sheet.t = Number(answer.headers.get("X-Time"));
  $("shown").textContent = `${sheet.t.toFixed(2)} s`;
  view.show(image);
}

async function snapped(at) {
  const radius = Number($("radius").value);
  if (!$("snap").checked || !(radius > 0 && radius <= 100)) return at;
  const answer = await post("snap", { t: sheet.t, mark: at, radius });
  return answer.found ? answer.mark : at;
}

view.onPick = async at => {
  if (sheet.noun === "point") { sheet.add(await snapped(at)); focusMetres(); return; }
  if (!view.began) { view.began = at; hint(); return; }
  const line = [...view.began, ...at];
  if (Math.hypot(line[2] - line[0], line[3] - line[1]) < 2) return;
  view.began = null;
  sheet.add(await snapped(line)); focusMetres();
};
view.onMove = (k, end, at) => { sheet.marks[k].at.splice(end, 2, ...at); sheet.changed(); };
view.onDrop = async (k, end) => {
  const mark = sheet.marks[k], whole = sheet.noun === "line";
  const moved = await snapped(whole ? mark.at : mark.at.slice(end, end + 2));
  if (whole) mark.at = moved; else mark.at.splice(end, 2, ...moved);
  sheet.changed();
};

// After a click the metres of the new mark are typed at once.
function focusMetres() {
  const row = $("table").tBodies[0].rows[sheet.chosen], input = row?.querySelectorAll("input:not([readonly])")[sheet.noun === "point" ? 2 : 0];
  if (input && sheet.chosen >= sheet.patterned) input.focus({ preventScroll: matchMedia("(max-width: 800px)").matches });
}

function pattern() {
  const number = id => Number($(id).value) || 0;
  const kind = $("pattern").value;
  const pairs = $("pairs").value.split("\n").map(line => line.trim().split(/[\s,;]+/).map(Number)).filter(row => row.length === 3 && row.every(Number.isFinite));
  return {
    typed: { kind }, dashes: { kind, width: number("lane"), period: number("period"), dash: number("dash") },
    rectangle: { kind, width: number("width"), length: number("length") }, distances: { kind, pairs },
  }[kind];
}

function settings() {
  sheet.pattern = pattern();
  for (const part of document.querySelectorAll("[data-pattern]")) part.hidden = part.dataset.pattern !== sheet.pattern.kind;
  sheet.changed();
}

function hint() {
  const lines = sheet.noun === "line";
  $("hint").textContent = lines
    ? (view.began ? "Click the other end of the line." : "Click two places on a line of the ground, then type two points of the same line in metres; ends need not correspond.")
    : "Click marks on the ground you know. Drag to move a mark or the picture, wheel or pinch to zoom.";
}

sheet.addEventListener("change", () => {
  $("line").textContent = sheet.line + 1;
  $("undo").disabled = !sheet.undoable; $("clear").disabled = !sheet.marks.length;
  document.querySelector(`[name=noun][value=${sheet.noun}]`).checked = true;
  $("patterns").hidden = sheet.noun === "line";
  hint(); view.draw();
});
sheet.addEventListener("choose", () => view.draw());
sheet.addEventListener("fit", () => {
  const { fit } = sheet, verdict = $("verdict");
  verdict.classList.toggle("good", fit.fits);
  verdict.textContent = fit.fits
    ? `off by ${fit.rms_px.toFixed(2)} px, ${fit.rms_m.toFixed(3)} m (rms)` + (fit.expect_kmh === null ? "" : `; expect \u00b1${fit.expect_kmh.toFixed(1)} km/h (95 %) on 50 km/h over 1 s`)
    : fit.reason;
  $("warnings").replaceChildren(...(fit.warnings ?? []).map(text => { const item = document.createElement("li"); item.textContent = text; return item; }));
  $("save").disabled = !fit.fits;
  view.draw();
});

$("view").addEventListener("keydown", event => {
  const step = event.shiftKey ? 10 : event.altKey ? 0.1 : 1;
  const way = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] }[event.key];
  const mark = sheet.marks[sheet.chosen];
  if (way && mark) { sheet.remember(); mark.at = mark.at.map((value, k) => value + way[k % 2]); sheet.changed(); }
  else if (way) { const at = view.cursor ?? view.size.map(side => side / 2); view.cursor = [at[0] + way[0], at[1] + way[1]]; view.draw(); }
  else if (event.key === "Enter" && view.cursor) view.onPick(view.cursor);
  else if ((event.key === "Delete" || event.key === "Backspace") && mark) sheet.remove(sheet.chosen);
  else if (event.key === "Escape") { view.began = null; sheet.choose(-1); hint(); }
  else if (event.key === "+" || event.key === "=") view.zoomBy(1.25);
  else if (event.key === "-") view.zoomBy(0.8);
  else return;
  event.preventDefault();
});
addEventListener("keydown", event => {
  if ((event.ctrlKey || event.metaKey) && event.key === "z" && !event.target.matches("input, textarea")) { event.preventDefault(); sheet.undo(); }
});

for (const radio of document.querySelectorAll("[name=noun]")) radio.addEventListener("change", () => { view.began = null; sheet.clear(radio.value); });
for (const id of ["pattern", "period", "lane", "dash", "width", "length", "pairs"]) $(id).addEventListener("input", settings);
for (const [id, name] of [["grid", "grid"], ["colours", "colours"]]) $(id).addEventListener("change", () => {
  view[name] = $(id).checked; $("legend").hidden = !view.colours; view.draw();
});
$("next").addEventListener("click", () => { sheet.line = Math.max(-1, ...sheet.marks.map(mark => mark.line)) + 1; sheet.changed(); });
$("undo").addEventListener("click", () => sheet.undo());
$("clear").addEventListener("click", () => sheet.clear());
$("in").addEventListener("click", () => view.zoomBy(1.5));
$("out").addEventListener("click", () => view.zoomBy(1 / 1.5));
$("whole").addEventListener("click", () => view.whole());
$("time").addEventListener("input", () => { clearTimeout(last); last = setTimeout(() => showFrame(Number($("time").value)), 120); });
function step(way) {
  const t = Math.min(about.duration, Math.max(0, sheet.t + (way + 0.25) * about.interval));
  $("time").value = t; showFrame(t);
}
$("earlier").addEventListener("click", () => step(-1));
$("later").addEventListener("click", () => step(1));
$("save").addEventListener("click", async () => {
  $("save").disabled = true;
  const answer = await post("save", sheet.body());
  if (answer.failed || answer.gone) { $("verdict").textContent = answer.reason; $("save").disabled = false; return; }
  $("end").querySelector("h2").textContent = "Saved. You may close this page.";
  $("end").querySelector("pre").textContent = answer.text;
  $("end").showModal();
});

about = await (await fetch("about")).json();
$("name").textContent = about.name;
$("time").max = about.duration; $("time").disabled = $("earlier").disabled = $("later").disabled = !about.duration;
if (about.before) {
  sheet.noun = about.before.noun;
  sheet.marks = about.before.marks.map((at, k) => ({ at, world: about.before.world[k], line: 0 }));
}
await showFrame(0);
settings();
