// The marks and what is known of them: the one state of this page, and its questions to the server.
const HISTORY = 100;
const LATER_MS = 60;

export class Sheet extends EventTarget {
  noun = "point"; marks = []; chosen = -1; line = 0; pattern = { kind: "typed" };
  t = 0; fit = null; #past = []; #timer = 0; #asked = 0;

  changed() {
    this.dispatchEvent(new Event("change"));
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#ask(), LATER_MS);
  }

  remember() {
    this.#past.push(JSON.stringify([this.noun, this.marks, this.line]));
    if (this.#past.length > HISTORY) this.#past.shift();
  }

  get undoable() { return this.#past.length > 0; }

  undo() {
    if (!this.undoable) return;
    [this.noun, this.marks, this.line] = JSON.parse(this.#past.pop());
    this.choose(-1);
    this.changed();
  }

  add(at) {
    this.remember();
    this.marks.push({ at, world: Array(at.length).fill(null), line: this.line });
    this.chosen = this.marks.length - 1;
    this.changed();
    return this.chosen;
  }

  remove(k) {
    this.remember();
    this.marks.splice(k, 1);
    this.chosen = -1;
    this.changed();
  }

  clear(noun = this.noun) {
    if (this.marks.length) this.remember();
    this.noun = noun; this.marks = []; this.chosen = -1; this.line = 0;
    this.changed();
  }

  choose(k) {
    this.chosen = k;
    this.dispatchEvent(new Event("choose"));
  }

  // How many of the first marks have their metres from the pattern.
  get patterned() {
    const kind = this.noun === "line" ? "typed" : this.pattern.kind;
    return { typed: 0, rectangle: Math.min(4, this.marks.length), dashes: Infinity, distances: Infinity }[kind];
  }

  body() {
    return {
      t: this.t, noun: this.noun, marks: this.marks.map(mark => mark.at), lines: this.marks.map(mark => mark.line),
      world: this.marks.map(mark => mark.world.every(Number.isFinite) ? mark.world : null),
      pattern: this.noun === "line" ? { kind: "typed" } : this.pattern,
    };
  }

  async #ask() {
    const number = ++this.#asked;
    const answer = await post("fit", this.body());
    if (number !== this.#asked) return; // a later question is on its way
    this.fit = answer;
    this.dispatchEvent(new Event("fit"));
  }
}

export async function post(name, body) {
  const answer = await fetch(name, {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body),
  }).catch(() => null);
  if (!answer) return { fits: false, gone: true, reason: "the tool has ended; start it again" };
  const text = await answer.text();
  try { return { ...JSON.parse(text), failed: !answer.ok }; } catch { return { fits: false, failed: true, reason: text }; }
}
