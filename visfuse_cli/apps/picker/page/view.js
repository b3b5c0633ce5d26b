// The frame on a canvas: zoom, loupe, marks, grid and error map. Image pixels have their centres at whole numbers.
const LOUPE = 150, LOUPE_ZOOM = 8, NEAR = 12, COLOURS = ["#28be46", "#b4dc28", "#ffe100", "#ff8c00", "#f02828", "#6e0082"];
const LEVELS = [1, 2, 5, 10, 20], MOST_ZOOM = 40, RESIDUALS = 10;

export class View {
  image = null; size = [1, 1]; zoom = 1; left = 0; top = 0; cursor = null; began = null;
  grid = true; colours = false; onPick = () => {}; onMove = () => {}; onDrop = () => {};
  #fitted = true; #canvas; #sheet; #pointers = new Map(); #press = null; #pinch = null;

  constructor(canvas, sheet) {
    this.#canvas = canvas; this.#sheet = sheet;
    canvas.addEventListener("pointerdown", event => this.#down(event));
    canvas.addEventListener("pointermove", event => this.#moved(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, event => this.#up(event));
    canvas.addEventListener("pointerleave", () => { if (!this.#press) { this.cursor = null; this.draw(); } });
    canvas.addEventListener("wheel", event => { event.preventDefault(); this.zoomBy(Math.exp(-event.deltaY / 400), this.#here(event)); }, { passive: false });
    new ResizeObserver(() => this.#fitted && this.image ? this.whole() : this.draw()).observe(canvas);
  }

  show(image) {
    const first = !this.image;
    this.image = image; this.size = [image.width, image.height];
    if (first) this.whole(); else this.draw();
  }

  whole() {
    const { clientWidth: wide, clientHeight: tall } = this.#canvas, [w, h] = this.size;
    this.zoom = Math.min(wide / w, tall / h);
    this.left = (w - wide / this.zoom) / 2 - 0.5; this.top = (h - tall / this.zoom) / 2 - 0.5;
    this.#fitted = true;
    this.draw();
  }

  zoomBy(factor, at = [this.#canvas.clientWidth / 2, this.#canvas.clientHeight / 2]) {
    const fixed = this.toImage(at), least = 0.5 * Math.min(this.#canvas.clientWidth / this.size[0], this.#canvas.clientHeight / this.size[1]);
    this.zoom = Math.min(MOST_ZOOM, Math.max(least, this.zoom * factor));
    this.#fitted = false;
    this.left = fixed[0] - at[0] / this.zoom; this.top = fixed[1] - at[1] / this.zoom;
    this.draw();
  }

  toImage([x, y]) { return [this.left + x / this.zoom, this.top + y / this.zoom]; }
  toCanvas([u, v]) { return [(u - this.left) * this.zoom, (v - this.top) * this.zoom]; }

  #here(event) { const box = this.#canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; }

  // The mark, and the end of it, under a place on the canvas.
  #under(at) {
    let best = null, least = NEAR;
    this.#sheet.marks.forEach((mark, k) => {
      for (let end = 0; end < mark.at.length; end += 2) {
        const [x, y] = this.toCanvas(mark.at.slice(end, end + 2)), far = Math.hypot(x - at[0], y - at[1]);
        if (far < least) { least = far; best = { k, end }; }
      }
    });
    return best;
  }

  #down(event) {
    this.#canvas.setPointerCapture(event.pointerId);
    this.#pointers.set(event.pointerId, this.#here(event));
    if (this.#pointers.size === 2) { this.#press = null; this.#pinch = this.#span(); return; }
    const at = this.#here(event);
    this.#press = { at, under: event.button === 0 ? this.#under(at) : null, left: this.left, top: this.top, far: false, button: event.button };
  }

  #span() {
    const [a, b] = [...this.#pointers.values()];
    return { far: Math.hypot(a[0] - b[0], a[1] - b[1]), middle: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2] };
  }

  #moved(event) {
    const at = this.#here(event);
    this.cursor = this.toImage(at);
    if (this.#pointers.has(event.pointerId)) this.#pointers.set(event.pointerId, at);
    if (this.#pinch && this.#pointers.size === 2) {
      const now = this.#span();
      this.left -= (now.middle[0] - this.#pinch.middle[0]) / this.zoom; this.top -= (now.middle[1] - this.#pinch.middle[1]) / this.zoom;
      this.zoomBy(now.far / this.#pinch.far, now.middle);
      this.#pinch = now;
      return;
    }
    const press = this.#press;
    if (press) {
      if (!press.far && Math.hypot(at[0] - press.at[0], at[1] - press.at[1]) > 4) {
        press.far = true;
        if (press.under) { this.#sheet.remember(); this.#sheet.choose(press.under.k); }
      }
      if (press.far && press.under) this.onMove(press.under.k, press.under.end, this.cursor);
      else if (press.far) { this.#fitted = false; this.left = press.left - (at[0] - press.at[0]) / this.zoom; this.top = press.top - (at[1] - press.at[1]) / this.zoom; }
    }
    this.draw();
  }

  #up(event) {
    this.#pointers.delete(event.pointerId);
    if (this.#pointers.size < 2) this.#pinch = null;
    const press = this.#press;
    this.#press = null;
    if (!press || event.type === "pointercancel") return;
    if (press.far) { if (press.under) this.onDrop(press.under.k, press.under.end); return; }
    if (press.button !== 0) return;
    if (press.under && !this.began) this.#sheet.choose(press.under.k);
    else this.onPick(this.toImage(press.at));
    this.draw();
  }

  draw() {
    const canvas = this.#canvas, scale = window.devicePixelRatio || 1;
    canvas.width = Math.round(canvas.clientWidth * scale); canvas.height = Math.round(canvas.clientHeight * scale);
    const pen = canvas.getContext("2d");
    pen.scale(scale, scale);
    this.#scene(pen, p => this.toCanvas(p), this.zoom);
    if (this.cursor) this.#loupe(pen);
  }

  #scene(pen, place, zoom) {
    if (this.image) {
      const [x, y] = place([-0.5, -0.5]);
      pen.imageSmoothingEnabled = zoom < 2;
      pen.drawImage(this.image, x, y, this.size[0] * zoom, this.size[1] * zoom);
    }
    const fit = this.#sheet.fit;
    if (fit?.fits && this.colours) this.#errors(pen, place, zoom, fit.errors);
    if (fit?.fits && this.grid) this.#lines(pen, place, fit.grid);
    this.#marks(pen, place, fit?.fits && fit.mapped.length === this.#sheet.marks.length ? fit : null);
  }

  #errors(pen, place, zoom, { step, kmh }) {
    const map = new OffscreenCanvas(kmh[0].length, kmh.length), dot = map.getContext("2d"), [x, y] = place([-step / 2, -step / 2]);
    kmh.forEach((row, i) => row.forEach((value, k) => {
      const level = LEVELS.findIndex(most => value < most);
      dot.fillStyle = value === null ? "#000" : COLOURS[level < 0 ? 5 : level];
      dot.fillRect(k, i, 1, 1);
    }));
    pen.globalAlpha = 0.4; pen.imageSmoothingEnabled = false;
    pen.drawImage(map, x, y, map.width * step * zoom, map.height * step * zoom);
    pen.globalAlpha = 1;
  }

  #lines(pen, place, grid) {
    pen.lineWidth = 1; pen.strokeStyle = "#ffffffb0"; pen.font = "11px system-ui";
    for (const { axis, metres, pieces } of grid) {
      pen.beginPath();
      for (const piece of pieces) piece.forEach((p, k) => k ? pen.lineTo(...place(p)) : pen.moveTo(...place(p)));
      pen.stroke();
      const seen = pieces.flat().filter(([u, v]) => u > 0 && v > 0 && u < this.size[0] && v < this.size[1]);
      if (seen.length) tag(pen, `${"XY"[axis]} ${metres}`, place(seen[Math.floor(seen.length / (axis ? 2 : 8))]), "#eee");
    }
  }

  #marks(pen, place, fit) {
    pen.font = "12px system-ui";
    this.#sheet.marks.forEach((mark, k) => {
      const used = fit ? fit.residuals[k].used : true, colour = k === this.#sheet.chosen ? "#ffd54a" : used ? "#4fc3f7" : "#ff6b6b";
      const ends = [];
      for (let end = 0; end < mark.at.length; end += 2) ends.push(mark.at.slice(end, end + 2));
      if (ends.length === 2) stroke(pen, ends.map(place), colour, 2);
      ends.forEach((end, e) => {
        const [x, y] = place(end);
        if (fit && ends.length === 1 && fit.mapped[k].every(Number.isFinite)) {
          const off = place([0, 1].map(a => end[a] + RESIDUALS * (fit.mapped[k][a] - end[a])));
          stroke(pen, [[x, y], off], "#ff5ad0", 2);
        }
        pen.strokeStyle = "#000"; pen.lineWidth = 3; ring(pen, x, y); pen.strokeStyle = colour; pen.lineWidth = 1.5; ring(pen, x, y);
        if (!e) tag(pen, String(k + 1), [x + 8, y - 8], colour);
      });
    });
    if (this.began && this.cursor) stroke(pen, [place(this.began), place(this.cursor)], "#ffd54a", 2);
  }

  #loupe(pen) {
    const { clientWidth: wide } = this.#canvas, [x, y] = this.toCanvas(this.cursor), zoom = Math.max(LOUPE_ZOOM, this.zoom * 2);
    const size = Math.min(LOUPE, wide * 0.36), corner = [x < wide / 2 ? wide - size - 8 : 8, 8];
    const place = ([u, v]) => [corner[0] + size / 2 + (u - this.cursor[0]) * zoom, corner[1] + size / 2 + (v - this.cursor[1]) * zoom];
    pen.save();
    pen.beginPath(); pen.roundRect(...corner, size, size, 8); pen.fillStyle = "#000"; pen.fill(); pen.clip();
    this.#scene(pen, place, zoom);
    stroke(pen, [[corner[0], corner[1] + size / 2], [corner[0] + size, corner[1] + size / 2]], "#ffd54a90", 1);
    stroke(pen, [[corner[0] + size / 2, corner[1]], [corner[0] + size / 2, corner[1] + size]], "#ffd54a90", 1);
    tag(pen, `${this.cursor[0].toFixed(1)}, ${this.cursor[1].toFixed(1)}`, [corner[0] + 5, corner[1] + size - 6], "#fff");
    pen.restore();
    pen.strokeStyle = "#fff"; pen.lineWidth = 1; pen.beginPath(); pen.roundRect(...corner, size, size, 8); pen.stroke();
    stroke(pen, [[x - 9, y], [x + 9, y]], "#ffd54a", 1); stroke(pen, [[x, y - 9], [x, y + 9]], "#ffd54a", 1);
  }
}

function ring(pen, x, y) { pen.beginPath(); pen.arc(x, y, 6, 0, 7); pen.moveTo(x - 1.5, y); pen.lineTo(x + 1.5, y); pen.moveTo(x, y - 1.5); pen.lineTo(x, y + 1.5); pen.stroke(); }

function stroke(pen, points, colour, width) {
  pen.strokeStyle = colour; pen.lineWidth = width; pen.beginPath();
  points.forEach((p, k) => k ? pen.lineTo(...p) : pen.moveTo(...p)); pen.stroke();
}

function tag(pen, text, [x, y], colour) {
  pen.font = "12px system-ui"; pen.fillStyle = "#000a"; pen.fillRect(x - 2, y - 11, pen.measureText(text).width + 4, 14);
  pen.fillStyle = colour; pen.fillText(text, x, y);
}
