// The tracer in WebGPU compute. Rays, what they ask and what they are told stay on the adapter: each step is a few
// dispatches whose sizes the adapter itself counted, and the page reads back a picture, and how many rays are left.

const MOST_RAYS = 2 ** 18;    // of a strip
const SLOT = 256, KIND = 8;   // bytes of a step's numbers in a list, and of those for values and for jets
const STEPS = [6, 10, 16, 32, 64, 128, 256]; // that are sent at once; together as many as a ray may take
const ACCEPT = 0.35, MOST_ACCEPT = 5e-4;  // Newton steps that a jet may end with: in pixels, and in units of the field
const MOST_LEVELS = 5;
const MARCH = 256; // rays that a workgroup looks at

const wgsl = (number) => (Number.isInteger(number) ? `${number}.0` : String(number));

async function gpuDevice() {
  try {
    const adapter = await navigator.gpu?.requestAdapter({ powerPreference: 'high-performance' });
    if (!adapter) return null;
    const { maxStorageBufferBindingSize, maxBufferSize } = adapter.limits; // all that it has, for wide networks
    return await adapter.requestDevice({ requiredLimits: { maxStorageBufferBindingSize, maxBufferSize } });
  } catch {
    return null;
  }
}

class GpuTracer {
  constructor(device, parts, { header, arrays }) {
    Object.assign(this, { device, parts, header });
    const saved = networksOf(header);
    this.nets = saved.map((network) => packNetwork(layersOf(arrays, network)));
    this.shell = shellArrays(header, arrays);
    this.counts = { values: saved.map(() => 0), jets: saved.map(() => 0), passes: 0, read: 0 };
    this.colors = header.colors && new Colors(this, header.colors);
    this.gone = null;
    device.lost.then(({ message }) => { this.gone = message || 'lost'; });
  }

  // A tracer, or null where there is no adapter that can hold this field.
  static async open(parts, saved) {
    const { header } = saved;
    if (header.levels.length > MOST_LEVELS || networksOf(header).some((net) => scratchOf(net) > MOST_SCRATCH)) return null;
    const device = await gpuDevice();
    if (!device) return null;
    device.pushErrorScope('validation');
    device.pushErrorScope('out-of-memory');
    const tracer = new GpuTracer(device, parts, saved);
    try {
      await tracer.build();
    } catch {
      return null; // a driver that refuses a kernel; WebGL 2 may do
    }
    const errors = [await device.popErrorScope(), await device.popErrorScope()];
    return errors.some(Boolean) ? null : tracer;
  }

  // Whether the device is gone; what it had under way fails a moment before it says so.
  async isLost() {
    await new Promise((resolve) => { setTimeout(resolve, 50); });
    return this.gone !== null;
  }

  close() {
    this.device.destroy();
  }

  // The moment, of a field that moves: b + t w, the weights of time folded into the first biases.
  at(time) {
    this.nets.forEach(({ starts, bias, rate }, index) => {
      if (rate) this.device.queue.writeBuffer(this.weights[index], 16 * starts.bias[0], bias.map((part, n) => part + time * rate[n]));
    });
  }

  get kind() {
    return 'WebGPU';
  }

  buffer(size, usage) {
    return this.device.createBuffer({ size: 4 * Math.ceil(size / 4), usage });
  }

  filled(numbers, usage) {
    const buffer = this.buffer(numbers.byteLength, usage | GPUBufferUsage.COPY_DST);
    this.device.queue.writeBuffer(buffer, 0, numbers);
    return buffer;
  }

  layout(...kinds) {
    const entry = (kind, binding) => {
      const place = { binding, visibility: GPUShaderStage.COMPUTE };
      if (kind === 'texture') return { ...place, texture: { sampleType: 'unfilterable-float' } };
      const [type, dynamic] = kind.split(' ');
      return { ...place, buffer: { type, hasDynamicOffset: Boolean(dynamic) } };
    };
    return this.device.createBindGroupLayout({ entries: kinds.map(entry) });
  }

  group(layout, ...resources) {
    return this.device.createBindGroup({ layout, entries: resources.map((resource, binding) => ({ binding, resource })) });
  }

  async build() {
    const { device, parts } = this;
    const [read, write, slots] = ['read-only-storage', 'storage', 'storage dynamic'];
    this.layouts = {
      network: this.layout('uniform', read, write, read, `${read} dynamic`, write, slots, write),
      begin: this.layout('uniform', 'texture', 'texture', write, write, write, slots),
      march: this.layout('uniform', write, write, read, `${read} dynamic`, write, write, slots),
    };
    const numbers = { BOLDNESS, SLACK, BAND_ENTRY, STEEPEST_RISE, SHALLOW, FLOOR, ROUNDING: 2e-6, STEEP: 3, STEEP_HOP: 0.5, REACH: 4 };
    const constants = Object.entries(numbers).map(([name, number]) => `const ${name}=${wgsl(number)};`).join('') + `const PATIENCE=${PATIENCE}u;`;
    const compute = (layout, entryPoint, code) => device.createComputePipelineAsync({
      layout: device.createPipelineLayout({ bindGroupLayouts: [layout] }),
      compute: { module: device.createShaderModule({ code }), entryPoint },
    });
    const { network, begin, march } = this.layouts;
    const tracing = (part, jet) => `${parts.get('gpu.lists')}${parts.get('gpu.rays')}${constants}const JET=${jet}u;${parts.get(`gpu.${part}`)}`;
    const hull = device.createShaderModule({ code: parts.get('gpu.hull') });
    const drawn = (depthCompare) => device.createRenderPipelineAsync({
      layout: 'auto',
      vertex: { module: hull, entryPoint: 'corner', buffers: [{ arrayStride: 12, attributes: [{ shaderLocation: 0, offset: 0, format: 'float32x3' }] }] },
      fragment: { module: hull, entryPoint: 'away', targets: [{ format: 'r32float' }] },
      depthStencil: { format: 'depth32float', depthCompare, depthWriteEnabled: true },
    });
    const levels = this.header.levels.length;
    const kernels = this.nets.map((net, index) => (index < levels ? ['value', 'jet'] : ['color']).map((kind) => compute(network, 'network', networkKernel(net, kind, parts))));
    [this.kernels, this.begins, this.marches, this.nearest, this.farthest] = await Promise.all([
      Promise.all(kernels.map((both) => Promise.all(both))),
      compute(begin, 'begin', tracing('begin', 0)),
      Promise.all([0, 1].map((jet) => compute(march, 'march', tracing('march', jet)))),
      drawn('less'),
      drawn('greater'),
    ]);
    const { STORAGE, UNIFORM, COPY_SRC, COPY_DST, VERTEX, INDEX } = GPUBufferUsage;
    this.weights = this.nets.map((net) => this.filled(net.numbers, STORAGE));
    this.corners = this.filled(this.shell.places, VERTEX);
    this.faces = this.filled(this.shell.faces, INDEX);
    this.view = this.buffer(96, UNIFORM | COPY_DST);
    this.frame = this.buffer(144, UNIFORM | COPY_DST);
    this.gates = this.nets.map(() => this.buffer(32, UNIFORM | COPY_DST));
    const steps = STEPS.reduce((sum, some) => sum + some, 1);
    const empty = new Uint32Array((steps * SLOT) / 4);
    for (let step = 0; step < steps; step++) {
      for (const kind of [0, 1]) empty.set([0, step], (step * SLOT + kind * KIND) / 4);
    }
    this.empty = this.filled(empty, COPY_SRC);
    const counts = () => this.buffer(empty.byteLength, STORAGE | COPY_SRC | COPY_DST);
    // Level 0 has two lists: one is read while the next step's is written.
    this.slots = { first: [counts(), counts()], finer: this.nets.map(counts), asked: counts() };
    this.groups = this.nets.map((net) => Math.min(MOST_GROUPS, Math.floor(MOST_SCRATCH / scratchOf(net))));
    this.scratch = this.buffer(Math.max(...this.nets.map((net, index) => this.groups[index] * scratchOf(net))), STORAGE);
    this.room = 0;
  }

  // Room for so many rays.
  reserve(rays) {
    if (rays <= this.room) return;
    for (const one of [this.rays, this.places, this.seen, this.identity, this.ends, ...(this.lists ?? [])]) one?.destroy();
    const { STORAGE, COPY_SRC, COPY_DST, MAP_READ } = GPUBufferUsage;
    const room = 2 ** Math.ceil(Math.log2(Math.max(rays, 1024)));
    this.room = room;
    this.rays = this.buffer(64 * room, STORAGE);
    this.places = this.buffer(32 * room, STORAGE | COPY_SRC | COPY_DST);
    this.seen = this.buffer(16 * room, STORAGE | COPY_SRC | COPY_DST);
    this.lists = Array.from({ length: this.nets.length + 2 }, () => this.buffer(8 * room, STORAGE));
    this.identity = this.filled(Uint32Array.from({ length: 2 * room }, (_, i) => i % room), STORAGE);
    this.ends = this.buffer(32 * room + (this.nets.length + 2) * MOST_STEPS * SLOT, MAP_READ | COPY_DST);
    const slot = (buffer) => ({ buffer, size: 2 * KIND });
    const whole = (buffer) => ({ buffer });
    const levels = this.header.levels.length;
    // The groups of network j; level 0's and those of colours read from `list` and its slots.
    const asked = (j, list, slots) => {
      const last = j >= levels - 1;
      const next = last ? [this.lists.at(-1), this.slots.finer[0]] : [this.lists[2 + j], this.slots.finer[j + 1]];
      return this.group(this.layouts.network, whole(this.gates[j]), whole(this.weights[j]), whole(this.places), whole(list), slot(slots), whole(next[0]), slot(next[1]), whole(this.scratch));
    };
    const [even, odd] = this.slots.first;
    this.asks = {
      first: [asked(0, this.lists[0], even), asked(0, this.lists[1], odd)],
      finer: this.nets.map((_, j) => (j && j < levels ? asked(j, this.lists[1 + j], this.slots.finer[j]) : null)),
      host: asked(0, this.identity, this.slots.asked),
      colors: this.header.colors && asked(levels, this.identity, this.slots.asked),
    };
    const marched = (here, there) => this.group(
      this.layouts.march, whole(this.frame), whole(this.rays), whole(this.places), whole(this.lists[here]),
      slot(this.slots.first[here]), whole(this.seen), whole(this.lists[there]), slot(this.slots.first[there]),
    );
    this.looks = [marched(0, 1), marched(1, 0)];
  }

  // Up to which values of each level the next one is asked; none after `level`.
  setGates(level, ends) {
    const { deltas, taper, levels } = this.header;
    levels.forEach((_, j) => {
      const next = j < level ? ends[j] : 0;
      const numbers = new ArrayBuffer(32);
      new Float32Array(numbers, 0, 4).set([j ? deltas[j - 1] : 0, taper, next, DEEP * next]);
      new Uint32Array(numbers, 16, 2).set([this.room, j]);
      this.device.queue.writeBuffer(this.gates[j], 0, numbers);
    });
    for (const gate of this.gates.slice(levels.length)) this.device.queue.writeBuffer(gate, 16, Uint32Array.from([this.room, 0]));
  }

  // The networks up to `level`, of a step, for at most so many rays: values (kind 0) or jets (1).
  evaluate(pass, kind, level, step, group, rays) {
    for (let j = 0; j <= level; j++) {
      pass.setPipeline(this.kernels[j][kind]);
      // A level's list is empty in its slots of other steps, and the last one's next is never written.
      pass.setBindGroup(0, j ? this.asks.finer[j] : group, [step * SLOT, step * SLOT]);
      pass.dispatchWorkgroups(this.crew(j, rays));
      this.counts.passes++;
    }
  }

  // Workgroups for a network and so many rays; they go on with the next when they are done.
  crew(net, rays) {
    return Math.min(this.groups[net], Math.ceil(rays / (LANES * OWN)));
  }

  clear(encoder) {
    for (const slots of [...this.slots.first, ...this.slots.finer]) encoder.copyBufferToBuffer(this.empty, 0, slots, 0, this.empty.size);
  }

  // Bytes of buffers, one behind the other, as soon as the adapter has written them.
  async fetch(encoder, sources) {
    let at = 0;
    for (const [buffer, start, size] of sources) {
      encoder.copyBufferToBuffer(buffer, start, this.ends, at, size);
      at += size;
    }
    this.device.queue.submit([encoder.finish()]);
    await this.ends.mapAsync(GPUMapMode.READ, 0, at);
    const bytes = this.ends.getMappedRange(0, at).slice(0);
    this.ends.unmap();
    this.counts.read += at;
    return bytes;
  }

  // What networks say at a list of points: gradient and value of each, or its colour.
  async ask(points, count, level, kind) {
    const found = new Float32Array(4 * count);
    for (let first = 0; first < count; first += MOST_RAYS) {
      const many = Math.min(MOST_RAYS, count - first);
      this.reserve(many);
      this.setGates(level, this.header.deltas);
      const staged = new Float32Array(8 * many);
      for (let i = 0; i < many; i++) for (let c = 0; c < 3; c++) staged[8 * i + c] = points[3 * (first + i) + c];
      const { queue } = this.device;
      queue.writeBuffer(this.places, 0, staged);
      const net = kind === 'color' ? this.header.levels.length : 0, jet = kind === 'jet' ? 1 : 0;
      queue.writeBuffer(this.slots.asked, jet * KIND, Uint32Array.from([many]));
      const encoder = this.device.createCommandEncoder();
      this.clear(encoder);
      const pass = encoder.beginComputePass();
      if (kind === 'color') {
        pass.setPipeline(this.kernels[net][0]);
        pass.setBindGroup(0, this.asks.colors, [0, 0]);
        pass.dispatchWorkgroups(this.crew(net, many));
        this.counts.passes++;
      } else {
        this.evaluate(pass, jet, level, 0, this.asks.host, many);
      }
      pass.end();
      const bytes = await this.fetch(encoder, [[this.places, 0, 32 * many], ...this.slots.finer.map((slots) => [slots, 0, 2 * KIND])]);
      const told = new Float32Array(bytes, 0, 8 * many);
      for (let i = 0; i < many; i++) found.set(told.subarray(8 * i + 4, 8 * i + 8), 4 * (first + i));
      const counted = this.counts[jet ? 'jets' : 'values'];
      counted[net] += many;
      if (kind !== 'color') for (let j = 1; j <= level; j++) counted[j] += new Uint32Array(bytes, 32 * many + 2 * KIND * j, 4)[2 * jet];
    }
    return found;
  }

  async value(points, count, level) {
    const found = await this.ask(points, count, level, 'value');
    return Float32Array.from({ length: count }, (_, i) => found[4 * i + 3]);
  }

  async jet(points, count, level) {
    const found = await this.ask(points, count, level, 'jet');
    const gradient = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) for (let c = 0; c < 3; c++) gradient[3 * i + c] = found[4 * i + c];
    return { value: Float32Array.from({ length: count }, (_, i) => found[4 * i + 3]), gradient };
  }

  color(points, count) {
    return this.ask(points, count, 0, 'color');
  }

  // See Tracer.trace.
  async trace(camera, { level, normalLevel = level, first = 0, rows = camera.height, precision = null, colored = false, clip = null }) {
    const { width } = camera;
    const seen = new Float32Array(4 * width * rows);
    const strip = Math.max(1, Math.floor(MOST_RAYS / width));
    if (width > MOST_RAYS) throw new PageError('This picture is too wide.');
    for (let row = 0; row < rows; row += strip) {
      const many = Math.min(strip, rows - row);
      seen.set(await this.strip(camera, { level, first: first + row, rows: many, precision, clip }), 4 * width * row);
    }
    let color = new Float32Array(0);
    if (colored || normalLevel !== level) {
      const { pixels, points } = hitsOf(camera, seen, first);
      if (normalLevel !== level) {
        const { gradient } = await this.jet(points, pixels.length, normalLevel);
        pixels.forEach((pixel, i) => {
          const length = Math.hypot(...gradient.subarray(3 * i, 3 * i + 3)) || 1;
          for (let c = 0; c < 3; c++) seen[4 * pixel + c] = gradient[3 * i + c] / length;
        });
      }
      if (colored) {
        color = new Float32Array(seen.length);
        const colors = await this.colors.at(points, pixels.length);
        pixels.forEach((pixel, i) => color.set(colors.subarray(3 * i, 3 * i + 3), 4 * pixel));
      }
    }
    return { seen, color };
  }

  async strip(camera, { level, first, rows, precision, clip }) {
    const { device } = this;
    const { width } = camera;
    this.reserve(width * rows);
    this.setGates(level, this.header.reach[level]);
    this.setFrame(camera, { level, first, rows, precision, clip });
    const hull = this.drawHull(width, rows);
    let encoder = device.createCommandEncoder();
    this.clear(encoder);
    encoder.clearBuffer(this.seen, 0, 16 * width * rows);
    for (const [pipeline, texture, depth] of [[this.nearest, hull.near, 1], [this.farthest, hull.far, 0]]) {
      const pass = encoder.beginRenderPass({
        colorAttachments: [{ view: texture.createView(), clearValue: [0, 0, 0, 0], loadOp: 'clear', storeOp: 'store' }],
        depthStencilAttachment: { view: hull.depth.createView(), depthClearValue: depth, depthLoadOp: 'clear', depthStoreOp: 'discard' },
      });
      pass.setPipeline(pipeline);
      pass.setBindGroup(0, this.group(pipeline.getBindGroupLayout(0), { buffer: this.view }));
      pass.setVertexBuffer(0, this.corners);
      pass.setIndexBuffer(this.faces, 'uint32');
      pass.drawIndexed(this.shell.faces.length);
      pass.end();
      this.counts.passes++;
    }
    let step = 0, left = width * rows;
    for (const steps of STEPS) {
      const from = step, pass = encoder.beginComputePass();
      if (!from) {
        const whole = (buffer) => ({ buffer });
        pass.setPipeline(this.begins);
        pass.setBindGroup(0, this.group(
          this.layouts.begin, whole(this.frame), hull.near.createView(), hull.far.createView(), whole(this.rays), whole(this.places),
          whole(this.lists[0]), { buffer: this.slots.first[0], size: 2 * KIND },
        ), [0]);
        pass.dispatchWorkgroups(Math.ceil((width * rows) / 64));
        this.counts.passes++;
      }
      for (; step < from + steps; step++) {
        const here = step % 2;
        for (const kind of [0, 1]) this.evaluate(pass, kind, level, step, this.asks.first[here], left);
        for (const kind of [0, 1]) {
          pass.setPipeline(this.marches[kind]);
          pass.setBindGroup(0, this.looks[here], [step * SLOT, (step + 1) * SLOT]);
          pass.dispatchWorkgroups(Math.ceil(left / MARCH));
          this.counts.passes++;
        }
      }
      pass.end();
      left = await this.look(encoder, level, from, step);
      if (!left) break;
      encoder = device.createCommandEncoder();
    }
    const bytes = await this.fetch(device.createCommandEncoder(), [[this.seen, 0, 16 * width * rows]]);
    return new Float32Array(bytes);
  }

  // Counts what was asked in steps [from, to), and returns how many rays are left.
  async look(encoder, level, from, to) {
    const size = (to - from + 1) * SLOT;
    const sources = [...this.slots.first, ...this.slots.finer.slice(1, level + 1)];
    const bytes = await this.fetch(encoder, sources.map((slots) => [slots, from * SLOT, size]));
    const count = (source, step, kind) => new Uint32Array(bytes, source * size + (step - from) * SLOT + kind * KIND, 1)[0];
    for (let step = from; step < to; step++) {
      for (let j = 0; j <= level; j++) {
        const source = j ? 1 + j : step % 2;
        this.counts.values[j] += count(source, step, 0);
        this.counts.jets[j] += count(source, step, 1);
      }
    }
    return count(to % 2, to, 0) + count(to % 2, to, 1);
  }

  setFrame(camera, { level, first, rows, precision, clip }) {
    const { eye, right, down, forward, fx, fy, cx, cy, width } = camera;
    const { radius, reach, deltas } = this.header;
    const far = Math.hypot(...eye) + 3;
    const { queue } = this.device;
    queue.writeBuffer(this.view, 0, Float32Array.from([...right, 0, ...down, 0, ...forward, 0, ...eye, 0, fx, fy, cx, cy - first, width, rows, far / 4096, far]));
    const rule = ruleOf(camera, radius, precision);
    const numbers = new ArrayBuffer(144), real = new Float32Array(numbers), whole = new Uint32Array(numbers);
    real.set([...right, 0, ...down, 0, ...forward, 0, ...eye, radius, fx, fy, cx, cy, rule.tolerance, rule.resolution, rule.accept, rule.size]);
    [whole[3], whole[7], whole[11]] = [width, rows, first];
    whole.set([level, Number(dot3(eye, eye) < (1.5 * radius) ** 2), this.room], 24);
    real[27] = level ? BAND_ENTRY * deltas[0] : 0;
    if (clip) [real[28 + clip.axis], real[31]] = [1, clip.at];
    real.set(reach[level], 32);
    queue.writeBuffer(this.frame, 0, numbers);
  }

  drawHull(width, rows) {
    if (this.hull?.width !== width || this.hull.rows !== rows) {
      if (this.hull) for (const name of ['near', 'far', 'depth']) this.hull[name].destroy();
      const texture = (format, usage) => this.device.createTexture({ size: [width, rows], format, usage });
      const { RENDER_ATTACHMENT, TEXTURE_BINDING } = GPUTextureUsage;
      this.hull = {
        width, rows, depth: texture('depth32float', RENDER_ATTACHMENT),
        near: texture('r32float', RENDER_ATTACHMENT | TEXTURE_BINDING), far: texture('r32float', RENDER_ATTACHMENT | TEXTURE_BINDING),
      };
    }
    return this.hull;
  }
}
