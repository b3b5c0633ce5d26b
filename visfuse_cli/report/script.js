"use strict";
// Each section follows its own video, or its own time slider where there is none.
const GRID = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500], TRAIL_S = 3;
const colour = id => `hsl(${((id * 0.61803398875) % 1) * 360} 65% 48%)`;

for (const section of document.querySelectorAll("section:has(script.tracks)")) {
  const { tracks, lanes } = JSON.parse(section.querySelector("script.tracks").textContent);
  const videos = [...section.querySelectorAll("video")], canvas = section.querySelector("canvas.map");
  const rows = [...section.querySelectorAll("tr[data-track]")], figures = [...section.querySelectorAll(".speeds")];
  const several = new Set(tracks.map(track => track.clip)).size > 1;
  const last = Math.max(0, ...tracks.map(track => track.path.at(-1)[0])), first = Math.min(last, ...tracks.map(track => track.path[0][0]));
  const slider = section.querySelector(".play input"), button = section.querySelector(".play button"), clock = section.querySelector(".play output");
  let shown = videos[0], chosen = null, playing = 0;
  Object.assign(slider, { min: first, max: last, value: last });

  const clipOf = video => several && video ? video.dataset.clip : null;
  const here = track => clipOf(shown) === null || track.clip === clipOf(shown);
  const begin = video => Number(video.dataset.begin); // of a video, in the footage
  const time = () => shown ? begin(shown) + shown.currentTime : Number(slider.value);
  const seek = (video, t) => { video.currentTime = Math.max(0, t - begin(video)); };
  const points = [...tracks.flatMap(track => track.path.map(p => [p[1], p[2]])), ...lanes.flat()];
  const reach = axis => points.reduce((r, p) => [Math.min(r[0], p[axis]), Math.max(r[1], p[axis])], [Infinity, -Infinity]);
  const [left, right] = points.length ? reach(0) : [0, 1], [low, high] = points.length ? reach(1) : [0, 1];

  function draw() {
    const scale = window.devicePixelRatio || 1, wide = canvas.clientWidth, tall = canvas.clientHeight;
    canvas.width = wide * scale; canvas.height = tall * scale;
    const pen = canvas.getContext("2d"), style = getComputedStyle(document.body), now = time();
    pen.scale(scale, scale); pen.font = "11px system-ui"; pen.lineJoin = "round";
    const zoom = 0.88 * Math.min(wide / Math.max(right - left, 2), tall / Math.max(high - low, 2));
    const at = (x, y) => [wide / 2 + (x - (left + right) / 2) * zoom, tall / 2 - (y - (low + high) / 2) * zoom];
    const line = path => { pen.beginPath(); path.forEach((p, k) => k ? pen.lineTo(...at(...p)) : pen.moveTo(...at(...p))); };
    pen.fillStyle = style.getPropertyValue("--lane");
    for (const lane of lanes) { line(lane); pen.fill(); }
    grid(pen, style, wide, tall, zoom, at);
    lanes.forEach((lane, k) => pen.fillText(`lane ${k + 1}`, ...at(...[0, 1].map(a => lane.reduce((sum, p) => sum + p[a], 0) / lane.length))));
    for (const track of tracks.filter(here)) {
      const tone = track.rejected ? style.getPropertyValue("--faint") : colour(track.id), mine = track.id === chosen;
      pen.strokeStyle = pen.fillStyle = tone;
      pen.globalAlpha = mine ? 0.8 : 0.25; pen.lineWidth = mine ? 2 : 1;
      line(track.path.map(p => [p[1], p[2]])); pen.stroke();
      pen.globalAlpha = 1;
      const k = track.path.findLastIndex(p => p[0] <= now + 1e-3);
      if (k < 0 || now > track.path.at(-1)[0] + 0.15) continue;
      pen.lineWidth = 2.5; line(track.path.slice(0, k + 1).filter(p => p[0] > now - TRAIL_S).map(p => [p[1], p[2]])); pen.stroke();
      const [x, y] = at(track.path[k][1], track.path[k][2]);
      pen.beginPath(); pen.arc(x, y, mine ? 6 : 4, 0, 7); pen.fill(); pen.fillText(track.id, x + 7, y - 5);
    }
    mark(now);
  }

  function grid(pen, style, wide, tall, zoom, at) {
    pen.strokeStyle = style.getPropertyValue("--line"); pen.fillStyle = style.getPropertyValue("--faint"); pen.lineWidth = 1;
    const step = GRID.find(s => s * zoom > 36) || 1000, middle = [(left + right) / 2, (low + high) / 2], span = [wide / zoom / 2, tall / zoom / 2];
    for (const axis of [0, 1]) for (let k = Math.ceil((middle[axis] - span[axis]) / step); k * step < middle[axis] + span[axis]; k++) {
      const [x, y] = axis ? at(middle[0], k * step) : at(k * step, middle[1]), text = String(Number((k * step).toFixed(3)));
      pen.beginPath();
      if (axis) { pen.moveTo(0, y); pen.lineTo(wide, y); pen.fillText(text, 3, y - 3); } else { pen.moveTo(x, 0); pen.lineTo(x, tall); pen.fillText(text, x + 3, tall - 4); }
      pen.stroke();
    }
  }

  // What is seen now, and what was chosen, in the tables and on the time axis.
  const byId = new Map(tracks.map(track => [String(track.id), track]));
  function mark(now) {
    for (const row of rows) {
      const track = byId.get(row.dataset.track);
      row.classList.toggle("now", !!track && here(track) && track.path[0][0] <= now && now <= track.path.at(-1)[0]);
      row.classList.toggle("chosen", !!track && track.id === chosen);
    }
    for (const figure of figures) {
      figure.parentElement.hidden = figures.length > 1 && clipOf(shown) !== null && figure.parentElement.dataset.clip !== clipOf(shown);
      figure.querySelector(".cursor")?.setAttribute("transform", `translate(${Math.max(0, (now - figure.dataset.begin) * figure.dataset.second)} 0)`);
      const some = chosen !== null && figure.querySelector(`.track-${chosen}`) !== null;
      figure.classList.toggle("some", some);
      for (const part of figure.querySelectorAll("g[class^=track-]")) part.classList.toggle("chosen", some && part.classList.contains(`track-${chosen}`));
    }
    clock.textContent = `${now.toFixed(1)} s`;
  }

  function show(video) {
    if (!video) return;
    for (const each of videos) { each.parentElement.hidden = each !== video; if (each !== video) each.pause(); }
    if (!several && shown !== video) seek(video, time());
    shown = video;
    draw();
  }

  function play() {
    const begun = performance.now(), from = Number(slider.value) >= last ? first : Number(slider.value);
    const step = () => {
      slider.value = from + (performance.now() - begun) / 1000;
      draw();
      if (Number(slider.value) < last) playing = requestAnimationFrame(step); else stop();
    };
    button.textContent = "Pause"; playing = requestAnimationFrame(step);
  }
  function stop() { cancelAnimationFrame(playing); playing = 0; button.textContent = "Play"; }
  button.addEventListener("click", () => playing ? stop() : play());
  slider.addEventListener("input", () => { stop(); draw(); });

  const menu = section.querySelector("select");
  menu?.addEventListener("change", () => show(videos[menu.value]));
  for (const video of videos) {
    for (const event of ["timeupdate", "seeked", "loadedmetadata"]) video.addEventListener(event, draw);
    if (video.requestVideoFrameCallback) { const follow = () => { draw(); video.requestVideoFrameCallback(follow); }; video.requestVideoFrameCallback(follow); }
  }
  for (const row of rows) row.addEventListener("click", () => {
    chosen = row.dataset.track === "" || Number(row.dataset.track) === chosen ? null : Number(row.dataset.track);
    const wanted = several ? videos.findIndex(video => video.dataset.clip === row.dataset.clip) : videos.indexOf(shown);
    if (wanted >= 0) { show(videos[wanted]); if (menu) menu.value = wanted; seek(shown, Number(row.dataset.seek)); }
    else if (!videos.length) { stop(); slider.value = row.dataset.seek; }
    draw();
  });
  new ResizeObserver(draw).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
}

for (const table of document.querySelectorAll("table.sortable")) table.querySelectorAll("th").forEach((head, column) => head.querySelector("button").addEventListener("click", () => {
  const down = head.getAttribute("aria-sort") === "ascending", body = table.tBodies[0];
  table.querySelectorAll("th").forEach(each => each.removeAttribute("aria-sort")); head.setAttribute("aria-sort", down ? "descending" : "ascending");
  const value = row => { const text = row.cells[column].textContent.trim(), number = parseFloat(text); return Number.isNaN(number) ? text : number; };
  const order = (a, b) => { const x = value(a), y = value(b); return typeof x === typeof y ? (x < y ? -1 : x > y ? 1 : 0) : typeof x === "number" ? -1 : 1; };
  [...body.rows].sort((a, b) => down ? order(b, a) : order(a, b)).forEach(row => body.append(row));
}));
