// Networks on the GPU, in WebGL2: lists of points in, values and gradients out.
//
// Layers are products of matrices over batches of points, so that a network may be of any width and depth, and only
// points that are in the list cost anything: who compacts the list has compacted the work.

const ROW = 2048;       // width of the textures: every WebGL2 has that
const BATCH = 4 * ROW;  // points whose activations are kept at a time

const FORMATS = (gl) => ({ internal: gl.RGBA32F, format: gl.RGBA, type: gl.FLOAT });

function compile(gl, parts, vertex, fragment, defines = []) {
  const program = gl.createProgram();
  const head = '#version 300 es\nprecision highp float;\nprecision highp int;\n' + defines.map((name) => `#define ${name}\n`).join('');
  for (const [type, text] of [[gl.VERTEX_SHADER, parts.get(vertex)], [gl.FRAGMENT_SHADER, parts.get('sine') + parts.get(fragment)]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, head + text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
    throw new PageError(`The graphics driver refuses a shader (${fragment}): ${[...logs, gl.getProgramInfoLog(program)].join(' ').trim()}`);
  }
  const places = new Map();
  return {
    program,
    at(name) {
      if (!places.has(name)) places.set(name, gl.getUniformLocation(program, name));
      return places.get(name);
    },
  };
}

function texture2d(gl, width, height, data = null) {
  const texture = gl.createTexture();
  const { internal, format, type } = FORMATS(gl);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, data);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return texture;
}

function target2d(gl, width, height) {
  const texture = texture2d(gl, width, height);
  const buffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  return { texture, buffer, width, height };
}

// Activations of a batch: four layers, one for each point of four.
function activations(gl, quads) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
  gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA32F, ROW, quads, 4);
  gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  const buffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
  const all = [0, 1, 2, 3].map((layer) => gl.COLOR_ATTACHMENT0 + layer);
  all.forEach((attachment, layer) => gl.framebufferTextureLayer(gl.FRAMEBUFFER, attachment, texture, 0, layer));
  gl.drawBuffers(all);
  return { texture, buffer };
}

// Rows of four numbers for `height` rows of `width`, zero beyond what `at(row, column)` gives: a texel is four rows of
// one column, so that a product takes four columns at once.
function matrixTexture(gl, rows, columns, at) {
  const width = columns, height = Math.ceil(rows / 4);
  const data = new Float32Array(4 * width * height);
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < columns; column++) data[4 * ((row >> 2) * width + column) + (row & 3)] = at(row, column);
  }
  return texture2d(gl, width, height, data);
}

function rowsTexture(gl, rows, columns, at) {
  const width = Math.ceil(columns / 4);
  const data = new Float32Array(4 * width * rows);
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < columns; column++) data[4 * width * row + column] = at(row, column);
  }
  return texture2d(gl, width, rows, data);
}

class Networks {
  constructor(gl, parts, layersOfAll) {
    this.gl = gl;
    this.programs = {
      firstSine: compile(gl, parts, 'plane', 'layer', ['FIRST']),
      sine: compile(gl, parts, 'plane', 'layer'),
      firstPhase: compile(gl, parts, 'plane', 'layer', ['FIRST', 'PHASE']),
      phase: compile(gl, parts, 'plane', 'layer', ['PHASE']),
      back: compile(gl, parts, 'plane', 'layer', ['BACK']),
      bend: compile(gl, parts, 'plane', 'bend'),
      seed: compile(gl, parts, 'plane', 'bend', ['SEED']),
      value: compile(gl, parts, 'plane', 'value'),
      triple: compile(gl, parts, 'plane', 'triple'),
    };
    this.nets = layersOfAll.map((layers) => this.upload(layers));
    const quads = Math.max(...this.nets.map((net) => net.quads));
    const phases = Math.max(...this.nets.map((net) => net.depth));
    this.work = [activations(gl, quads), activations(gl, quads)];
    this.phases = Array.from({ length: phases }, () => activations(gl, quads));
    this.rows = 0;
    this.reserve(4);
    this.counts = { values: layersOfAll.map(() => 0), jets: layersOfAll.map(() => 0), passes: 0, read: 0 };
    if (gl.getError() === gl.OUT_OF_MEMORY) throw new PageError('This graphics adapter has not the memory for these networks. `mplicits web --levels 1` writes a page of the coarsest alone.');
  }

  upload(layers) {
    const { gl } = this;
    const width = layers[0].bias.length, padded = 4 * Math.ceil(width / 4), depth = layers.length - 1;
    const { weight: last, bias: lastBias } = layers[depth];
    const net = { width, depth, quads: padded / 4, sines: [] };
    layers.slice(0, depth).forEach(({ weight, bias }, index) => {
      const inputs = weight.length / width;
      const forward = (row, column) => (column < inputs ? weight[row * inputs + column] : 0);
      net.sines.push({
        forward: matrixTexture(gl, width, index ? padded : inputs, forward),
        back: index
          ? matrixTexture(gl, width, padded, (row, column) => (column < width ? weight[column * width + row] : 0))
          : rowsTexture(gl, inputs, width, (row, column) => weight[inputs * column + row]),
        bias: rowsTexture(gl, 1, width, (_, column) => bias[column]),
      });
    });
    net.bias = layers[0].bias;
    net.rate = layers[0].rate; // of a field that moves: what its first biases gain with time
    net.output = rowsTexture(gl, lastBias.length, width, (row, column) => last[row * width + column]);
    net.outputBias = lastBias;
    return net;
  }

  // Ends it: the adapter's memory is given back.
  close() {
    const { gl } = this;
    for (const { program } of Object.values(this.programs)) gl.deleteProgram(program);
    for (const { sines, output } of this.nets) {
      for (const texture of [...sines.flatMap(({ forward, back, bias }) => [forward, back, bias]), output]) gl.deleteTexture(texture);
    }
    for (const held of [...this.work, ...this.phases, this.values, this.triples]) {
      gl.deleteTexture(held.texture);
      gl.deleteFramebuffer(held.buffer);
    }
    gl.deleteTexture(this.points);
  }

  // The moment, of a field that moves: b + t w, the weights of time folded into the first biases.
  at(time) {
    const { gl } = this;
    for (const { bias, rate, width, quads, sines } of this.nets) {
      if (!rate) continue;
      const numbers = new Float32Array(4 * quads);
      for (let i = 0; i < width; i++) numbers[i] = bias[i] + time * rate[i];
      gl.activeTexture(gl.TEXTURE0);
      gl.bindTexture(gl.TEXTURE_2D, sines[0].bias);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, quads, 1, gl.RGBA, gl.FLOAT, numbers);
    }
  }

  // Room for points, values and gradients of `rows` rows of points.
  reserve(rows) {
    const { gl } = this;
    if (rows <= this.rows) return;
    for (const held of [this.values, this.triples]) {
      if (held) {
        gl.deleteTexture(held.texture);
        gl.deleteFramebuffer(held.buffer);
      }
    }
    if (this.points) gl.deleteTexture(this.points);
    this.rows = 4 * Math.ceil(rows / 4);
    this.points = texture2d(gl, ROW, this.rows);
    this.values = target2d(gl, ROW, this.rows / 4);
    this.triples = target2d(gl, ROW, this.rows);
    this.staged = new Float32Array(4 * ROW * this.rows);
  }

  // Uploads points (x, y, z for each) as the shaders want them.
  load(points, count) {
    const { gl } = this;
    const rows = Math.ceil(count / ROW);
    this.reserve(rows);
    for (let i = 0; i < count; i++) {
      for (let c = 0; c < 3; c++) this.staged[4 * i + c] = points[3 * i + c];
    }
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.points);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, rows, gl.RGBA, gl.FLOAT, this.staged.subarray(0, 4 * ROW * rows));
  }

  bind(place, unit, name, texture, kind) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(kind, texture);
    gl.uniform1i(place.at(name), unit);
  }

  // One pass over a batch.
  pass(program, buffer, [x, y, width, height], { arrays = {}, planes = {}, whole = {} }) {
    const { gl } = this;
    gl.useProgram(program.program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.viewport(x, y, width, height);
    let unit = 0;
    for (const [name, texture] of Object.entries(arrays)) this.bind(program, unit++, name, texture, gl.TEXTURE_2D_ARRAY);
    for (const [name, texture] of Object.entries(planes)) this.bind(program, unit++, name, texture, gl.TEXTURE_2D);
    for (const [name, number] of Object.entries(whole)) gl.uniform1i(program.at(name), number);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    this.counts.passes++;
  }

  // Activations of the last sine layer; where phases are kept, those of every layer as well.
  sweep(net, base, wide, keep) {
    let held = null;
    net.sines.forEach((layer, index) => {
      const first = index === 0;
      const free = this.work.find((one) => one !== held);
      const into = keep ? this.phases[index] : free;
      const program = this.programs[first ? `first${keep ? 'Phase' : 'Sine'}` : keep ? 'phase' : 'sine'];
      this.pass(program, into.buffer, [0, 0, wide, net.quads], {
        arrays: first ? {} : { source: held.texture },
        planes: { weights: layer.forward, bias: layer.bias, ...(first ? { points: this.points } : {}) },
        whole: first ? { base } : { quads: net.quads },
      });
      if (keep) this.pass(this.programs.bend, free.buffer, [0, 0, wide, net.quads], { arrays: { phases: into.texture } });
      held = free;
    });
    return held;
  }

  addValues(net, held, base, wide) {
    const { gl } = this;
    const { value } = this.programs;
    gl.useProgram(value.program);
    gl.uniform1f(value.at('bias'), net.outputBias[0]);
    this.pass(value, this.values.buffer, [0, base / BATCH, wide, 1], {
      arrays: { source: held.texture },
      planes: { weights: net.output },
      whole: { quads: net.quads },
    });
  }

  addTriples(net, held, weights, bias, base, count) {
    const { gl } = this;
    const { triple } = this.programs;
    const row = base / ROW;
    gl.useProgram(triple.program);
    gl.uniform3f(triple.at('bias'), ...bias);
    this.pass(triple, this.triples.buffer, [0, row, Math.min(count, ROW), Math.ceil(count / ROW)], {
      arrays: { source: held.texture },
      planes: { weights },
      whole: { quads: net.quads, first: row },
    });
  }

  read(target, count, each) {
    const { gl } = this;
    const texels = Math.ceil((count * each) / 4);
    const width = Math.min(ROW, texels), height = Math.ceil(texels / ROW);
    const numbers = new Float32Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, numbers);
    this.counts.read += numbers.byteLength;
    return numbers;
  }

  each(count, work) {
    for (let base = 0; base < count; base += BATCH) {
      const here = Math.min(BATCH, count - base);
      work(base, here, Math.ceil(here / 4));
    }
  }

  // The values of a network at `count` points.
  value(index, points, count) {
    if (!count) return new Float32Array(0);
    const net = this.nets[index];
    this.load(points, count);
    this.each(count, (base, _, wide) => this.addValues(net, this.sweep(net, base, wide, false), base, wide));
    this.counts.values[index] += count;
    return this.read(this.values, count, 1);
  }

  // Three outputs of a network, as r, g, b and 1.
  color(index, points, count) {
    if (!count) return new Float32Array(0);
    const net = this.nets[index];
    this.load(points, count);
    this.each(count, (base, here, wide) => this.addTriples(net, this.sweep(net, base, wide, false), net.output, net.outputBias, base, here));
    this.counts.values[index] += count;
    return this.read(this.triples, count, 4);
  }

  // Values, and gradients by the sweep back: s_i = g_i cos z_i, g_(i-1) = s_i W_i.
  jet(index, points, count) {
    if (!count) return { value: new Float32Array(0), gradient: new Float32Array(0) };
    const net = this.nets[index];
    const { seed, back } = this.programs;
    this.load(points, count);
    this.each(count, (base, here, wide) => {
      const held = this.sweep(net, base, wide, true);
      this.addValues(net, held, base, wide);
      let from = held;
      this.pass(seed, from.buffer, [0, 0, wide, net.quads], {
        arrays: { phases: this.phases[net.depth - 1].texture },
        planes: { weights: net.output },
      });
      for (let layer = net.depth - 1; layer > 0; layer--) {
        const into = this.work.find((one) => one !== from);
        this.pass(back, into.buffer, [0, 0, wide, net.quads], {
          arrays: { source: from.texture, phases: this.phases[layer - 1].texture },
          planes: { weights: net.sines[layer].back },
          whole: { quads: net.quads },
        });
        from = into;
      }
      this.addTriples(net, from, net.sines[0].back, [0, 0, 0], base, here);
    });
    this.counts.jets[index] += count;
    return { value: this.read(this.values, count, 1), gradient: this.read(this.triples, count, 4) };
  }
}
