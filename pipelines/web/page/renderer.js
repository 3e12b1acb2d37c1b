// What the page asks of what traces and what rasterises: pictures, single points, values, and their cost. Each call is answered
// by a promise, one after the other, so that none meets the buffers of another half used.

const FIELD = 'surface'; // the field among the names of shapes

class Renderer {
  // `gl` is there for adapters that know no WebGPU.
  constructor(gl, parts, saved) {
    Object.assign(this, { gl, parts, saved, header: saved.header, tracer: null, shapes: null, camera: null, options: null });
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
    return this.tracer?.kind ?? this.shapes?.kind ?? null;
  }

  // Ends what is under way on the adapter; no other call may follow.
  close() {
    this.queue(() => {
      this.tracer?.close();
      this.shapes?.close();
    });
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

  // What a camera sees of the field, and of clouds and meshes; whichever is nearer.
  async look(camera, options) {
    const { levels, shapes } = this.header;
    const blank = () => ({ seen: new Float32Array(4 * camera.width * (options.rows ?? camera.height)), color: new Float32Array(0) });
    const traced = levels.length && !options.hidden?.includes(FIELD);
    const made = traced ? await this.traced((tracer) => tracer.trace(camera, options)) : blank();
    if (!shapes.length) return made;
    this.shapes ??= new Shapes(this.gl, this.parts, this.saved);
    return nearer(made, this.shapes.draw(camera, options), this.shapes.slack);
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
  // Options: level, normalLevel (whose normals), first, rows, colored, and precision: of depths, in units of the field; null is
  // a tenth of a pixel; clip: {axis, at}, a plane before which nothing is seen; hidden: names of shapes, or `FIELD`, that are
  // left out; time: of a field that moves, which single rays and values then stay at.
  frame(camera, options) {
    if (options.colored && !this.colored) throw new PageError('This page has no colours.');
    return this.queue(async () => {
      [this.camera, this.options] = [camera, options];
      this.clear();
      this.turn(options.time ?? this.time);
      const started = performance.now();
      const made = await this.look(camera, options);
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
    const { seen } = await this.queue(() => this.look(one, { ...options, first: 0, rows: 1, colored: false }));
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
