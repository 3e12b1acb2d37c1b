// A plane across an axis through the field. What stands before it is cut away; on it the values of the levels lie on a
// grid, asked for once for all cameras, between whose places they are interpolated.

const FIRST_GRID = 96, FINEST_GRID = 512, GRID_TIME = 300; // places along a side, milliseconds

// 1, 2 or 5 times a power of ten, near a number and not below.
function round125(number) {
  const power = 10 ** Math.floor(Math.log10(number));
  return power * [1, 2, 5, 10].find((step) => step * power >= number * (1 - 1e-9));
}

// x, y, z of the places of a square grid on the plane: rows along the second of the other two axes.
function gridPoints(axis, at, [low1, low2, high1, high2], side, first = 0, rows = side) {
  const points = new Float32Array(3 * side * rows);
  const one = (axis + 1) % 3, two = (axis + 2) % 3;
  for (let i = 0; i < side * rows; i++) {
    points[3 * i + axis] = at;
    points[3 * i + one] = low1 + ((high1 - low1) * (i % side)) / (side - 1);
    points[3 * i + two] = low2 + ((high2 - low2) * (first + Math.floor(i / side))) / (side - 1);
  }
  return points;
}

class Section {
  constructor({ shell, deltas, unit }) {
    Object.assign(this, { shell, deltas });
    this.axis = this.texture = null;
    this.at = 0;
    this.version = 0;
    const longest = Math.max(...shell.high.map((high, c) => high - shell.low[c]));
    this.spacing = round125((longest * unit) / 40) / unit; // of the lines, a round number of input units
  }

  // What the tracer has to know: rays begin at the plane.
  get clip() {
    return this.axis === null ? null : { axis: this.axis, at: this.at };
  }

  get extent() {
    const { low, high } = this.shell, one = (this.axis + 1) % 3, two = (this.axis + 2) % 3;
    return [low[one], low[two], high[one], high[two]];
  }

  // Across which axis, null for none, and where between the ends of the mesh around the band: 0 to 1.
  choose(axis, share) {
    this.version++;
    this.axis = axis;
    if (axis === null) this.drop();
    else this.at = this.shell.low[axis] + share * (this.shell.high[axis] - this.shell.low[axis]);
  }

  // The adapter was lost, and the grid with it.
  forget() {
    this.texture = this.made = null;
  }

  drop() {
    if (this.texture) this.gl.deleteTexture(this.texture);
    this.texture = null;
  }

  // A grid of values, coarse at first; `finer` one that takes some tenths of a second. Says whether there is a new one.
  async refresh(gl, renderer, level, finer = false) {
    if (!renderer.header.levels.length) return false; // a mesh has no values: it is cut, and that is all
    const state = `${this.version} ${level}`;
    if (this.axis === null || this.made === `${state} ${finer}` || (!finer && this.made?.startsWith(`${state} `) && this.texture)) return false;
    const side = finer ? this.finer ?? FIRST_GRID : FIRST_GRID;
    const coarser = Math.min(level, 3);
    const started = performance.now();
    const points = gridPoints(this.axis, this.at, this.extent, side);
    const asked = [level, ...Array(coarser).keys()];
    const found = [];
    for (const one of asked) found.push(await renderer.values(points, one));
    const each = (performance.now() - started) / side ** 2;
    if (`${this.version} ${level}` !== state) return false;
    this.finer = Math.round(Math.min(FINEST_GRID, Math.max(FIRST_GRID, Math.sqrt(GRID_TIME / each))));
    const numbers = new Float32Array(4 * side * side);
    found.forEach((values, channel) => { for (let i = 0; i < side * side; i++) numbers[4 * i + channel] = values[i]; });
    this.drop();
    this.gl = gl;
    this.texture = texture2d(gl, side, side, numbers);
    this.bands = [0, 1, 2].map((band) => (band < coarser ? this.deltas[band] : 0));
    this.made = `${state} ${finer}`;
    return true;
  }

  // Where a ray meets the plane, if it does on the grid: the depth.
  meets(eye, direction) {
    if (!this.texture) return Infinity;
    const depth = (this.at - eye[this.axis]) / direction[this.axis];
    const [low1, low2, high1, high2] = this.extent;
    const [one, two] = [1, 2].map((step) => eye[(this.axis + step) % 3] + depth * direction[(this.axis + step) % 3]);
    return depth > 0 && one >= low1 && one <= high1 && two >= low2 && two <= high2 ? depth : Infinity;
  }
}
