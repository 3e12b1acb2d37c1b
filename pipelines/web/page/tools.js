// What is under the pointer, a ruler between two places, and the marks of both over the picture.

const HOVER = 60; // milliseconds that the pointer rests before the field is asked

const along3 = (eye, direction, depth) => eye.map((part, c) => part + depth * direction[c]);

// Where a place of the field is on the picture, in pixels of the camera; null behind the eye.
function project({ eye, right, down, forward, fx, fy, cx, cy }, place) {
  const way = place.map((part, c) => part - eye[c]);
  const depth = dot3(way, forward);
  return depth > 1e-6 ? [(fx * dot3(way, right)) / depth + cx, (fy * dot3(way, down)) / depth + cy] : null;
}

// The unit direction of the ray through a pixel.
function rayOf({ right, down, forward, fx, fy, cx, cy }, x, y) {
  const across = (x - cx) / fx, below = (y - cy) / fy, length = Math.hypot(across, below, 1);
  return forward.map((part, c) => (part + right[c] * across + down[c] * below) / length);
}

// Coordinates with as many places as lengths of the input's unit deserve: five digits of the unit sphere's radius.
function coordinates(place, unit) {
  const places = Math.min(12, Math.max(0, 4 - Math.floor(Math.log10(unit))));
  return place.map((part) => part.toFixed(places)).join(', ');
}

class Tools {
  constructor(page) {
    this.page = page;
    this.ui = page.ui;
    this.ruler = { on: false, ends: [] };
    this.landmarks = null; // where two shapes are compared
    this.asked = 0;
    const { unit, center } = page.saved.header;
    this.unit = unit;
    this.input = (place) => place.map((part, c) => part * unit + center[c]);
  }

  // The field at a place of the canvas, in its CSS pixels: of the surface, or of the plane where that is nearer and solid.
  async probe(x, y) {
    const { page } = this, { camera, renderer, section } = page;
    const grid = renderer.camera, ratio = page.canvas.width / page.canvas.clientWidth;
    if (!grid) return null;
    const at = [(x * ratio * grid.width) / camera.width - 0.5, (y * ratio * grid.height) / camera.height - 0.5];
    const level = page.level;
    let hit = await renderer.pick(...at);
    const direction = rayOf(grid, ...at), crossed = section.meets(grid.eye, direction);
    const point = along3(grid.eye, direction, crossed);
    const onPlane = crossed < Infinity && (!hit || (await renderer.values(Float32Array.from(point), level))[0] < 0);
    if (onPlane) hit = { position: point, normal: null, depth: crossed };
    if (!hit) return null;
    const distances = [];
    for (let one = 0; one <= level && page.saved.header.levels.length; one++) distances.push((await renderer.values(Float32Array.from(hit.position), one))[0] * this.unit);
    return { ...hit, position: this.input(hit.position), place: hit.position, depth: hit.depth * this.unit, distances, onPlane };
  }

  // The pointer rests at a place of the canvas.
  hover(x, y) {
    clearTimeout(this.waiting);
    const asked = ++this.asked;
    this.waiting = setTimeout(() => this.read(x, y, asked).catch((error) => this.ui.failed(error)), HOVER);
  }

  async read(x, y, asked = ++this.asked) {
    if (this.page.lost) return;
    const found = await this.probe(x, y);
    if (asked === this.asked) this.say(found);
  }

  leave() {
    clearTimeout(this.waiting);
    this.asked++;
    this.say(null);
  }

  say(found) {
    const { reading } = this.ui;
    reading.hidden = !found;
    if (!found) return;
    const lines = [`${found.onPlane ? 'on the plane' : 'on the surface'}: ${coordinates(found.position, this.unit)}`];
    if (found.normal) lines.push(`normal ${found.normal.map((part) => part.toFixed(3)).join(', ')}`);
    if (found.distances.length) lines.push(`distance ${found.distances.map((distance, level) => `f${level} = ${distance.toPrecision(3)}`).join(', ')}`);
    lines.push(`from the eye ${digits(found.depth)}`);
    reading.textContent = lines.join('\n');
  }

  // A place was meant: the reading, and an end of the ruler.
  async tap(x, y) {
    const found = await this.probe(x, y);
    this.say(found);
    if (found && this.landmarks && !this.ruler.on) this.landmarks.pick(found.place);
    if (!found || !this.ruler.on) return;
    this.ruler.ends = [...(this.ruler.ends.length === 2 ? [] : this.ruler.ends), found];
    this.measure();
  }

  toggleRuler(on = !this.ruler.on) {
    this.ruler = { on, ends: [] };
    this.ui.ruler.setAttribute('aria-pressed', on);
    this.measure();
  }

  // Between the ends, in units of the input; null until there are two.
  get length() {
    const [a, b] = this.ruler.ends;
    return b ? Math.hypot(...b.position.map((part, c) => part - a.position[c])) : null;
  }

  measure() {
    const { on, ends } = this.ruler;
    const [a, b] = ends;
    const differences = b ? ` (${coordinates(b.position.map((part, c) => part - a.position[c]), this.unit)})` : '';
    this.ui.length.textContent = !on ? '' : b ? `${this.length.toPrecision(5)} input units${differences}` : `Ruler: ${ends.length ? 'now the other end' : 'click on one end'}`;
    this.ui.length.hidden = !on;
    if (!on) this.landmarks?.tell();
    this.draw();
  }

  // The marks, over a picture that has just been drawn.
  draw() {
    const { marks } = this.ui, { width, height } = this.page.canvas;
    if (marks.width !== width || marks.height !== height) Object.assign(marks, { width, height });
    const pen = marks.getContext('2d');
    pen.clearRect(0, 0, width, height);
    const ends = this.ruler.ends.map(({ place }) => project(this.page.camera, place)).filter((end) => end);
    const thick = width / Math.max(1, this.page.canvas.clientWidth);
    const line = (wide, color) => {
      Object.assign(pen, { lineWidth: wide * thick, strokeStyle: color, lineCap: 'round' });
      pen.beginPath();
      ends.forEach(([x, y]) => pen.lineTo(x, y));
      pen.stroke();
      for (const [x, y] of ends) {
        pen.beginPath();
        pen.arc(x, y, 4 * thick, 0, 7);
        pen.stroke();
      }
    };
    line(4, 'rgba(0, 0, 0, .6)');
    line(2, '#ffd34d');
    Object.assign(pen, { font: `600 ${13 * thick}px system-ui, sans-serif`, lineWidth: 4 * thick, strokeStyle: 'rgba(0, 0, 0, .75)', fillStyle: '#fff', textAlign: 'center' });
    const write = (text, x, y) => {
      pen.strokeText(text, x, y);
      pen.fillText(text, x, y);
    };
    if (ends.length === 2) write(this.length.toPrecision(4), (ends[0][0] + ends[1][0]) / 2, (ends[0][1] + ends[1][1]) / 2 - 10 * thick);
    for (const { number, place } of this.landmarks?.marks ?? []) {
      const [x, y] = project(this.page.camera, place) ?? [-99, -99];
      write(`\u2022 ${number}`, x, y + 4 * thick);
    }
  }
}
