// What the page asks of whatever traces: pictures, single points, values, and what they have cost. Each call is answered
// by a promise, one after the other, so that none meets the buffers of another half used.

class Renderer {
  // `gl` is there for adapters that know no WebGPU.
  constructor(gl, parts, saved) {
    Object.assign(this, { gl, parts, saved, header: saved.header, tracer: null, camera: null, options: null });
    const networks = networksOf(this.header);
    this.tally = { values: networks.map(() => 0), jets: networks.map(() => 0), passes: 0, read: 0 };
    this.time = 0;
    this.last = Promise.resolve();
  }

  // WebGPU where there is an adapter that takes this field, else WebGL 2; `?webgl` in the address asks for that.
  async open() {
    const forced = new URLSearchParams(location.search).has('webgl');
    const tracer = (!forced && await GpuTracer.open(this.parts, this.saved)) || new Tracer(this.gl, this.parts, this.saved);
    tracer.counts = this.tally;
    if (this.header.moves) tracer.at(this.time);
    this.tracer = tracer;
  }

  // What traces, or null before the first picture.
  get kind() {
    return this.tracer?.kind ?? null;
  }

  // Ends what is under way on the adapter; no other call may follow.
  close() {
    this.queue(() => this.tracer?.close());
  }

  // Work with the tracer; where its device was lost meanwhile, it is done again with another.
  async traced(work) {
    if (!this.tracer) await this.open();
    try {
      return await work(this.tracer);
    } catch (error) {
      if (!await this.tracer.isLost()) throw error;
      await this.open();
      return work(this.tracer);
    }
  }

  get colored() {
    return Boolean(this.header.colors);
  }

  queue(work) {
    const answer = this.last.then(work);
    this.last = answer.catch(() => {});
    return answer;
  }

  // What rows [first, first + rows) of a camera's picture see: `seen` has for each pixel, row by row from the upper left,
  // the normal and the depth along the ray, 0 where nothing is; `color` its own colours where they were asked for; and
  // what it has cost, see `counts`.
  //
  // Options: level, normalLevel (whose normals), first, rows, colored, and precision: of depths, in units of the field;
  // null is a tenth of a pixel; clip: {axis, at}, a plane before which nothing is seen;
  // time: of a field that moves, which single rays and values then stay at.
  frame(camera, options) {
    if (options.colored && !this.colored) throw new PageError('This page has no colours.');
    return this.queue(async () => {
      [this.camera, this.options] = [camera, options];
      this.clear();
      this.turn(options.time ?? this.time);
      const started = performance.now();
      const made = await this.traced((tracer) => tracer.trace(camera, options));
      const milliseconds = performance.now() - started;
      return { width: camera.width, height: camera.height, ...made, milliseconds, counts: structuredClone(this.tally) };
    });
  }

  // The moment of a field that moves, from now on.
  at(time) {
    return this.queue(() => this.turn(time));
  }

  turn(time) {
    if (!this.header.moves || time === this.time) return;
    this.time = time;
    this.tracer?.at(time);
  }

  // What stands at a place of the last frame, in its pixels from the middle of the upper left one: position, normal and
  // depth in the field's units, by a ray of its own; null where nothing is.
  async pick(x, y) {
    const { camera, options } = this;
    if (!camera) return null;
    const one = { ...camera, cx: camera.cx - x, cy: camera.cy - y, width: 1, height: 1 };
    const { seen } = await this.queue(() => this.traced((tracer) => tracer.trace(one, { ...options, first: 0, rows: 1, colored: false })));
    const [nx, ny, nz, depth] = seen;
    if (!depth) return null;
    const across = -one.cx / one.fx, down = -one.cy / one.fy, length = Math.hypot(across, down, 1);
    const position = one.eye.map((part, c) => part + (depth * (one.right[c] * across + one.down[c] * down + one.forward[c])) / length);
    return { position, normal: [nx, ny, nz], depth };
  }

  // The values of a level at points x, y, z, x, y, …, in the field's units.
  values(points, level) {
    return this.queue(() => this.traced((tracer) => tracer.value(points, points.length / 3, level)));
  }

  // Since the last picture began: of each network (those of colours last) the values and the jets that were asked for; passes
  // of the adapter, and bytes read back.
  counts() {
    return structuredClone(this.tally);
  }

  // What `frameTime` wants to know of this adapter, measured: the networks up to a level at what a picture saw, and a
  // picture of nothing.
  async adapter(camera, { seen }, level) {
    const { points } = hitsOf(camera, seen, 0), least = 3 * 16384;
    const many = new Float32Array(points.length * Math.max(1, Math.ceil(least / Math.max(1, points.length))));
    for (let at = 0; at < many.length; at += points.length) many.set(points, at);
    const timed = async (work) => {
      await work(); // once for what is made at the first time
      this.clear();
      const started = performance.now();
      await work();
      return performance.now() - started;
    };
    const computing = await timed(() => this.values(many, level));
    const done = this.operations(this.counts());
    const away = { ...camera, forward: camera.forward.map((part) => -part), right: camera.right.map((part) => -part) };
    const empty = await timed(() => this.frame(away, { level }));
    return { rate: done / computing, pass: empty / Math.max(1, this.counts().passes) };
  }

  clear() {
    for (const kind of ['values', 'jets']) this.tally[kind].fill(0);
    Object.assign(this.tally, { passes: 0, read: 0 });
  }

  // Operations of those counts: a product of a weight and a sum are two, and a jet goes through the matrices twice.
  operations({ values, jets }) {
    return networksOf(this.header).reduce((sum, { width, depth }, index) => {
      const once = 2 * width * (3 + (depth - 1) * width + 1);
      return sum + once * (values[index] + 2 * jets[index]);
    }, 0);
  }
}

// How long a picture takes by its counts, in milliseconds: an adapter does so many operations in one of them, and each
// pass costs so much even if it has nothing to do.
const frameTime = ({ operations, passes }, { rate, pass }) => operations / rate + passes * pass;

// What of a field an adapter can hold whose textures are so many texels wide: the levels up to the first that is wider,
// and a sentence about what is left out, or nothing. The widest of its textures has a column for each neuron.
function fitting(saved, widest) {
  const { header } = saved, fits = ({ width }) => width <= widest;
  const odd = header.levels.findIndex((level) => !fits(level));
  const limit = `this adapter holds ${widest} (MAX_TEXTURE_SIZE)`;
  if (odd === 0) throw new PageError(`Level 0 has ${header.levels[0].width} neurons in a layer; ${limit}. Another device may hold more.`);
  const colors = header.colors && fits(header.colors) ? header.colors : null;
  const bare = header.colors && !colors ? `The colours have ${header.colors.width} neurons in a layer; ${limit}. ` : '';
  if (odd < 0) return { saved: { ...saved, header: { ...header, colors } }, left: bare };
  const shown = {
    ...header, levels: header.levels.slice(0, odd), deltas: header.deltas.slice(0, odd - 1), reach: header.reach.slice(0, odd),
    rounding: header.rounding.slice(0, odd), colors: colors && { ...colors, level: Math.min(colors.level, odd - 1) },
  };
  return {
    saved: { ...saved, header: shown },
    left: `${bare}Level ${odd} has ${header.levels[odd].width} neurons in a layer; ${limit}. Level ${odd - 1} is the finest that fits. `,
  };
}

const openRenderer = (gl, parts, saved) => new Renderer(gl, parts, saved);
