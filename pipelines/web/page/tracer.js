// Rays to the surface of a level, as the tracer on the CPU sends them: from the mesh around level 0's band, by the widest
// steps that two tangent balls allow, to a change of sign that secants close in on; then one jet for each hit. All rays
// under way are looked at together, and those that are done leave the list, so that a level is evaluated in its band alone.

const PATIENCE = 32, BAND_ENTRY = 0.5, BOLDNESS = 0.9, STEEPEST_RISE = 0.6, MOST_STEPS = 512;
const FLOOR = 8 * 2 ** -23;
const TOLERANCE = 0.1, RESOLUTION = 0.75, NEWTON_REACH = 0.2, SHALLOW = 0.05, NEAREST = 0.05;
const MOST_MOVES = 10, ARRIVED = 1e-5, LEAST_SLOPE = 0.5;
const SLACK = 1e-4; // rounding of the depths of the mesh
const MOST_TOLERANCE = 2.5e-4;
const DEEP = 0.35; // share of level 0's band behind which a ray looks at its root before it asks finer levels

// How exactly depths are to be known, in units of the field: to `precision`, or to a tenth of a pixel; and the pixel.
function ruleOf(camera, radius, precision) {
  const size = Math.max(Math.hypot(...camera.eye) - radius, NEAREST) / Math.max(camera.fx, camera.fy);
  return {
    size, tolerance: precision ?? Math.min(TOLERANCE * size, MOST_TOLERANCE), resolution: precision ?? RESOLUTION * size,
    accept: precision ?? Math.min(ACCEPT * size, MOST_ACCEPT),
  };
}

// Which pixels of a picture's rows from `first` on show something, and the points that they show.
function hitsOf({ eye, right, down, forward, fx, fy, cx, cy, width }, seen, first) {
  const pixels = [], points = [];
  for (let pixel = 0; 4 * pixel < seen.length; pixel++) {
    const depth = seen[4 * pixel + 3];
    if (!depth) continue;
    const x = ((pixel % width) - cx) / fx, y = (first + Math.floor(pixel / width) - cy) / fy, length = Math.hypot(x, y, 1);
    pixels.push(pixel);
    for (let c = 0; c < 3; c++) points.push(eye[c] + (depth * (right[c] * x + down[c] * y + forward[c])) / length);
  }
  return { pixels, points: Float32Array.from(points) };
}

// Corners and faces of the mesh around the band.
function shellArrays({ shell }, arrays) {
  const codes = arrays.get('shell.vertices');
  const places = Float32Array.from(codes, (_, i) => {
    const c = i % 3, code = codes[(c * codes.length) / 3 + Math.floor(i / 3)];
    return shell.low[c] + (code / shell.grid) * (shell.high[c] - shell.low[c]);
  });
  return { places, faces: Uint32Array.from(arrays.get('shell.faces')) };
}

const dot3 = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

// A multiscale field: networks, the half-widths of their bands, and the gate that closes at the end of a band.
class Field {
  constructor(networks, { deltas, taper, levels }) {
    this.networks = networks;
    this.deltas = deltas;
    this.taper = taper;
    this.count = levels.length;
  }

  gate(f, delta) {
    if (!this.taper) return [1, 0];
    const u = Math.min(1, Math.max(0, (Math.abs(f) / delta - (1 - this.taper)) / this.taper));
    return [1 - u * u * (3 - 2 * u), (-6 * u * (1 - u) * Math.sign(f)) / (delta * this.taper)];
  }

  // Rows of `rows` whose value is inside a band, and their points.
  inside(f, rows, points, delta) {
    const kept = new Int32Array(rows ? rows.length : f.length);
    let count = 0;
    for (let i = 0; i < kept.length; i++) {
      const row = rows ? rows[i] : i;
      if (Math.abs(f[row]) < delta) kept[count++] = row;
    }
    const chosen = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) for (let c = 0; c < 3; c++) chosen[3 * i + c] = points[3 * kept[i] + c];
    return [kept.subarray(0, count), chosen];
  }

  // Finer levels are asked up to the values `ends` of those before: their bands, or as far as is of interest.
  value(points, count, level, ends = this.deltas) {
    const f = this.networks.value(0, points, count).slice(0, count);
    let rows = null;
    for (let j = 1; j <= level; j++) {
      let chosen;
      [rows, chosen] = this.inside(f, rows, points, ends[j - 1]);
      const own = this.networks.value(j, chosen, rows.length);
      rows.forEach((row, i) => { f[row] += this.gate(f[row], this.deltas[j - 1])[0] * own[i]; });
    }
    return f;
  }

  jet(points, count, level) {
    const first = this.networks.jet(0, points, count);
    const f = first.value.slice(0, count), g = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) for (let c = 0; c < 3; c++) g[3 * i + c] = first.gradient[4 * i + c];
    let rows = null;
    for (let j = 1; j <= level; j++) {
      let chosen;
      [rows, chosen] = this.inside(f, rows, points, this.deltas[j - 1]);
      const own = this.networks.jet(j, chosen, rows.length);
      rows.forEach((row, i) => {
        const [gate, slope] = this.gate(f[row], this.deltas[j - 1]);
        const steeper = 1 + slope * own.value[i];
        for (let c = 0; c < 3; c++) g[3 * row + c] = steeper * g[3 * row + c] + gate * own.gradient[4 * i + c];
        f[row] += gate * own.value[i];
      });
    }
    return { value: f, gradient: g };
  }
}

// Display colours around a surface: those of a network at points in the band of a level, the others first moved onto the
// surface by x - f g / |g|^2; what does not arrive there has the colour of what lies outside.
class Colors {
  // `source` answers value(points, count, level), jet(…) and color(points, count), or promises to.
  constructor(source, { level, delta, outside }) {
    Object.assign(this, { source, level, delta, outside });
  }

  async at(points, count) {
    const { source, delta } = this;
    const moved = points.slice(0, 3 * count);
    const reached = (await source.value(moved, count, this.level)).map((f) => Number(Math.abs(f) < delta));
    let away = Array.from(reached.keys()).filter((i) => !reached[i]);
    for (let step = 0; step <= MOST_MOVES && away.length; step++) {
      const places = Float32Array.from(away.flatMap((i) => [...moved.subarray(3 * i, 3 * i + 3)]));
      const { value, gradient } = await source.jet(places, away.length, this.level);
      away = away.filter((i, k) => {
        if (Math.abs(value[k]) < ARRIVED) {
          reached[i] = 1;
          return false;
        }
        const slope = Math.hypot(...gradient.subarray(3 * k, 3 * k + 3)) || 1;
        for (let c = 0; c < 3; c++) moved[3 * i + c] -= (value[k] * gradient[3 * k + c]) / slope / Math.max(slope, LEAST_SLOPE);
        return true;
      });
    }
    const found = await source.color(moved, count);
    const colors = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) {
      for (let c = 0; c < 3; c++) colors[3 * i + c] = reached[i] ? Math.min(1, Math.max(0, found[4 * i + c])) : this.outside[c];
    }
    return colors;
  }
}

class Tracer {
  constructor(gl, parts, { header, arrays }) {
    this.header = header;
    this.networks = new Networks(gl, parts, networksOf(header).map((network) => layersOf(arrays, network)));
    this.field = new Field(this.networks, header);
    this.colors = header.colors && new Colors({
      value: (...asked) => this.field.value(...asked),
      jet: (...asked) => this.field.jet(...asked),
      color: (points, count) => this.networks.color(header.levels.length, points, count),
    }, header.colors);
    this.hull = new Hull(gl, parts, arrays, header);
  }

  get kind() {
    return 'WebGL 2';
  }

  set counts(counts) {
    this.networks.counts = counts;
  }

  at(time) {
    this.networks.at(time);
  }

  // The page hears of a lost context itself, and begins anew.
  isLost() {
    return false;
  }

  close() {
    this.networks.close();
    this.hull.close();
  }

  value(points, count, level) {
    return this.field.value(points, count, level);
  }

  // The first level's reach that |f| = size is beyond: there the surface cannot be; 0 if there is none.
  band(size, level) {
    return this.header.reach[level].find((reach) => size >= reach) ?? 0;
  }

  // What rows [first, first + rows) of a camera's picture see: normal and depth of each pixel, depth 0 for nothing; and
  // where it is `colored`, the surface's own colours.
  // Depths are known to a tenth of a pixel, or to `precision` in units of the field.
  async trace(camera, { level, normalLevel = level, first = 0, rows = camera.height, precision = null, colored = false, clip = null }) {
    const { size, tolerance, resolution } = ruleOf(camera, this.header.radius, precision);
    const seen = new Float32Array(4 * camera.width * rows);
    const rays = this.begin(camera, first, rows, clip);
    const hits = this.march(camera, rays, level, tolerance, resolution);
    const points = this.points(camera, rays.direction, rays.depth, hits);
    const { value, gradient } = this.field.jet(points, hits.length, normalLevel);
    const reach = precision ?? NEWTON_REACH * size;
    const color = new Float32Array(colored ? seen.length : 0);
    hits.forEach((ray, i) => {
      const normal = [gradient[3 * i], gradient[3 * i + 1], gradient[3 * i + 2]];
      const length = Math.hypot(...normal) || 1;
      let depth = rays.depth[ray];
      if (level === normalLevel) {
        const slope = dot3(normal, rays.direction.subarray(3 * ray, 3 * ray + 3));
        if (Math.abs(slope) > SHALLOW * length) depth += Math.min(reach, Math.max(-reach, -value[i] / slope));
      }
      const at = 4 * rays.pixel[ray];
      for (let c = 0; c < 3; c++) seen[at + c] = normal[c] / length;
      seen[at + 3] = depth;
      for (let c = 0; c < 3; c++) points[3 * i + c] = camera.eye[c] + depth * rays.direction[3 * ray + c];
    });
    if (colored) {
      const colors = await this.colors.at(points, hits.length);
      hits.forEach((ray, i) => color.set(colors.subarray(3 * i, 3 * i + 3), 4 * rays.pixel[ray]));
    }
    return { seen, color };
  }

  // The rays that enter the mesh around the band, from where they do to where they leave it for good.
  begin(camera, first, rows, clip) {
    const { eye, right, down, forward, fx, fy, cx, cy, width } = camera;
    const { radius } = this.header;
    const crossings = this.hull.crossings(camera, first, rows);
    const most = width * rows;
    const rays = { count: 0, pixel: new Int32Array(most), depth: new Float64Array(most), far: new Float64Array(most), direction: new Float32Array(3 * most) };
    const distance2 = dot3(eye, eye), within = distance2 < (1.5 * radius) ** 2;
    for (let pixel = 0; pixel < most; pixel++) {
      const front = crossings[4 * pixel], back = crossings[4 * pixel + 1];
      if (!back) continue;
      const x = ((pixel % width) - cx) / fx, y = (first + Math.floor(pixel / width) - cy) / fy;
      const length = Math.hypot(x, y, 1), i = rays.count;
      let b = 0;
      for (let c = 0; c < 3; c++) {
        const part = (right[c] * x + down[c] * y + forward[c]) / length;
        rays.direction[3 * i + c] = part;
        b += part * eye[c];
      }
      const half = Math.sqrt(Math.max(0, b * b - distance2 + radius * radius));
      // A camera within the mesh sees its far side first: its rays begin at the eye.
      let start = Math.max(0, -b - half, within ? 0 : front - SLACK);
      const end = Math.min(-b + half, back + SLACK);
      if (clip) { // what stands before a plane across an axis is cut away: rays begin on the plane
        const met = (clip.at - eye[clip.axis]) / rays.direction[3 * i + clip.axis];
        if (!(met > 0)) continue;
        start = Math.max(start, met);
      }
      if (!half || start >= end) continue;
      rays.pixel[i] = pixel;
      rays.depth[i] = start;
      rays.far[i] = end;
      rays.count++;
    }
    return rays;
  }

  points({ eye }, direction, depth, rows) {
    const points = new Float32Array(3 * rows.length);
    for (let i = 0; i < rows.length; i++) {
      const ray = rows[i], t = depth[ray];
      for (let c = 0; c < 3; c++) points[3 * i + c] = eye[c] + t * direction[3 * ray + c];
    }
    return points;
  }

  // March all rays; `rays.depth` ends where each one hit, or gave up. Returns those that hit.
  march(camera, rays, level, tolerance, resolution) {
    const { count, depth, far, direction } = rays;
    const fill = (number) => new Float64Array(count).fill(number);
    const low = depth.slice(0, count), lowValue = fill(Infinity), high = fill(Infinity), highValue = fill(0);
    const free = fill(0), gap = fill(Infinity), boldness = fill(BOLDNESS), sign = fill(1);
    const hits = [];
    let under = Int32Array.from({ length: count }, (_, i) => i);
    for (let step = 1; step <= MOST_STEPS && under.length; step++) {
      const values = this.field.value(this.points(camera, direction, depth, under), under.length, level, this.header.reach[level]);
      const least = resolution * 2 ** Math.floor((step - 1) / PATIENCE);
      let left = 0;
      for (let k = 0; k < under.length; k++) {
        const i = under[k], t = depth[i];
        if (step === 1 && values[k] < 0) sign[i] = -1; // it began inside, and looks for the way out
        const value = values[k] * sign[i], size = Math.abs(value);
        const delta = this.band(size, level), room = Math.max(0, size - delta);
        const known = lowValue[i] < Infinity, enclosed = high[i] < Infinity;
        const slope = known ? (value - lowValue[i]) / (t - low[i]) : -1;
        const sound = enclosed || t - low[i] - free[i] - room <= gap[i];
        const before = sound && value > 0, behind = sound && value <= 0;
        const wasLow = low[i], wasHigh = high[i];
        if (before) [low[i], lowValue[i]] = [t, value];
        if (behind) [high[i], highValue[i]] = [t, value];
        const hop = Math.max(BAND_ENTRY * delta, least), s = Math.min(STEEPEST_RISE, Math.max(-1, slope));
        const closed = high[i] < Infinity, width = high[i] - low[i];
        const chord = low[i] + (width * lowValue[i]) / (lowValue[i] - highValue[i]);
        const steep = Math.min(1, Math.abs(slope));
        const near = sound && delta === 0 && size <= Math.max(tolerance * steep, FLOOR);
        const pinned = closed && width <= tolerance;
        if (near || pinned) {
          depth[i] = near ? t + Math.min(tolerance, Math.max(-tolerance, value / (steep || 1))) : chord;
          hits.push(i);
          continue;
        }
        if (before && !closed && t + room + hop >= far[i]) continue;
        let next;
        if (closed) {
          next = !enclosed || 2 * width <= wasHigh - wasLow ? chord : low[i] + width / 2;
        } else if (before) {
          const widest = (boldness[i] * room * (1 + s)) / (1 - s), zero = s < 0 ? value / -s : Infinity;
          next = t + room + Math.max(widest, Math.min(hop, zero - room));
        } else {
          next = wasLow + free[i]; // the step left too wide a gap: it is taken back, and the next are less bold
        }
        if (!sound && known) boldness[i] /= 2;
        if (before) free[i] = room;
        gap[i] = hop;
        depth[i] = Math.min(next, far[i]);
        under[left++] = i;
      }
      under = under.slice(0, left);
    }
    return Int32Array.from(hits);
  }
}
