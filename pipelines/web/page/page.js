// The page: what is on it, what moves the camera, and when pictures are traced. Whatever comes from the run is put in as
// text, never as HTML.

const byId = (id) => document.getElementById(id);
const COARSEST = 16, FINEST = 0.5; // canvas pixels per ray
const FRAME = 40, STRIP = 60, REST = 180; // milliseconds: of a picture while it moves, of a strip, before it is refined
const THEMES = {
  dark: { paper: [0.086, 0.094, 0.114], clay: [0.77, 0.72, 0.66] },
  light: { paper: [0.957, 0.949, 0.933], clay: [0.77, 0.72, 0.66] },
};

function tell(reason) {
  byId('reason').textContent = reason;
  byId('message').hidden = false;
  byId('panel').hidden = true;
}

const digits = (number) => Number(number.toPrecision(3)).toLocaleString('en', { maximumSignificantDigits: 3 });

class Page {
  constructor(saved, parts) {
    this.saved = saved;
    this.parts = parts;
    this.canvas = byId('picture');
    this.orbit = new Orbit(saved.header.view);
    this.level = this.normals = saved.header.levels.length - 1;
    this.shading = saved.header.colors ? 3 : 2; // 3 is colours in light, 4 bare colours; they want the network of colours
    this.factor = COARSEST; // canvas pixels per ray while it moves; less as soon as the adapter shows how fast it is
    this.speed = 200;     // pixels per millisecond
    const pixel = Number(new URLSearchParams(location.search).get('pixel')); // coarser at rest, for slow adapters
    this.finest = pixel > 0 ? Math.min(COARSEST, Math.max(FINEST, pixel)) : FINEST;
    this.drawn = 0;       // pictures so far
    this.version = 0;     // of what is to be seen; a refinement of an older one ends
    this.open();
    this.describe();
    this.listen();
    this.changed();
  }

  // A context and all that is in it; again after it was lost.
  open() {
    const gl = this.canvas.getContext('webgl2', { antialias: false, depth: false, alpha: false, powerPreference: 'high-performance' });
    if (!gl) throw new PageError('This browser has no WebGL 2, with which the page draws. Any current Chrome, Edge, Firefox or Safari has, if graphics acceleration is not switched off.');
    if (!gl.getExtension('EXT_color_buffer_float')) {
      throw new PageError('This graphics adapter cannot draw into float textures (EXT_color_buffer_float), in which the page computes. Another device can.');
    }
    this.gl = gl;
    this.renderer = openRenderer(gl, this.parts, this.saved);
    this.shade = compile(gl, this.parts, 'plane', 'shade');
    this.coarse = this.fine = null;
  }

  describe() {
    const { header } = this.saved;
    document.title = header.title;
    byId('title').textContent = header.title;
    const sizes = header.levels.map(({ width, depth }) => `${width} × ${depth}`).join(', ');
    const bands = header.deltas.length ? ` · bands δ = ${header.deltas.map((delta) => digits(delta * header.unit)).join(', ')} input units` : '';
    const exact = header.bits === null
      ? 'weights in float32'
      : `weights of ${header.bits} bits: off by ≤ ${digits(Math.max(...header.rounding.map((part) => part.value)) * header.unit)} units, ${digits(Math.max(...header.rounding.map((part) => part.angle)))}°`;
    byId('facts').textContent = `SIRENs ${sizes}${bands} · ${exact}`;
    for (const id of ['level', 'normals']) {
      header.levels.forEach((_, index) => byId(id).append(new Option(index === header.levels.length - 1 && index ? `${index} (finest)` : `${index}`, index)));
      byId(id).value = this.level;
    }
    const wanted = new URLSearchParams(location.search);
    const given = (wanted.get('camera') ?? '').split(',').map(Number);
    if (wanted.has('camera') && given.length === 2 && given.every(Number.isFinite)) {
      [this.orbit.azimuth, this.orbit.elevation] = [given[0], Math.min(90, Math.max(-90, given[1]))];
    }
    if (header.colors) byId('shading').prepend(new Option('colours', 3), new Option('bare colours', 4));
    byId('shading').value = this.shading;
    this.setTheme(matchMedia('(prefers-color-scheme: light)').matches ? 'light' : 'dark');
    byId('message').hidden = true;
    byId('panel').hidden = false;
  }

  setTheme(name) {
    this.theme = name;
    document.documentElement.dataset.theme = name;
  }

  listen() {
    const { canvas, orbit } = this;
    const held = new Map();
    const share = () => Math.min(canvas.clientWidth, canvas.clientHeight);
    canvas.addEventListener('pointerdown', (event) => {
      canvas.setPointerCapture(event.pointerId);
      held.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener('pointermove', (event) => {
      if (!held.has(event.pointerId)) return;
      const before = [...held.values()], [x, y] = held.get(event.pointerId);
      held.set(event.pointerId, [event.clientX, event.clientY]);
      const dx = (event.clientX - x) / share(), dy = (event.clientY - y) / share();
      if (before.length === 1) {
        if (event.buttons & 2 || event.buttons & 4 || event.shiftKey) orbit.pan(dx, dy);
        else orbit.turn(180 * dx, 180 * dy);
      } else if (before.length === 2) { // each finger moves the middle of the two by half
        const spread = ([[ax, ay], [bx, by]]) => Math.hypot(ax - bx, ay - by);
        orbit.pan(dx / 2, dy / 2);
        orbit.zoom(spread([...held.values()]) / Math.max(1, spread(before)));
      }
      this.changed();
    });
    for (const end of ['pointerup', 'pointercancel', 'lostpointercapture']) canvas.addEventListener(end, (event) => held.delete(event.pointerId));
    canvas.addEventListener('contextmenu', (event) => event.preventDefault());
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      const lines = event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? event.deltaY / 30 : event.deltaY;
      orbit.zoom(1.08 ** -Math.max(-8, Math.min(8, lines)));
      this.changed();
    }, { passive: false });
    canvas.addEventListener('keydown', (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const move = (x, y) => (event.shiftKey ? orbit.pan(x / 20, y / 20) : orbit.turn(6 * x, 6 * y));
      const keys = {
        ArrowLeft: () => move(-1, 0), ArrowRight: () => move(1, 0), ArrowUp: () => move(0, -1), ArrowDown: () => move(0, 1),
        '+': () => orbit.zoom(1.15), '=': () => orbit.zoom(1.15), '-': () => orbit.zoom(1 / 1.15), Home: () => orbit.reset(),
      };
      const level = Number(event.key);
      if (keys[event.key]) keys[event.key]();
      else if (event.key.trim() && level < this.saved.header.levels.length) this.choose(level, level);
      else return;
      event.preventDefault();
      this.changed();
    });
    byId('level').addEventListener('change', ({ target }) => this.choose(Number(target.value), Number(target.value)));
    byId('normals').addEventListener('change', ({ target }) => this.choose(this.level, Number(target.value)));
    byId('shading').addEventListener('change', ({ target }) => {
      this.shading = Number(target.value);
      if (this.shading > 2) this.changed();
      else this.present();
    });
    byId('reset').addEventListener('click', () => { orbit.reset(); this.changed(); });
    byId('theme').addEventListener('click', () => { this.setTheme(this.theme === 'dark' ? 'light' : 'dark'); this.present(); });
    byId('panel').addEventListener('submit', (event) => event.preventDefault());
    addEventListener('resize', () => this.changed());
    document.addEventListener('visibilitychange', () => { if (!document.hidden) this.changed(); });
    canvas.addEventListener('webglcontextlost', (event) => {
      event.preventDefault(); // or it would never come back
      this.version++;
      this.lost = true;
      tell('The graphics adapter was taken away from this page. It goes on as soon as it is back; if nothing happens, reload the page.');
    });
    canvas.addEventListener('webglcontextrestored', () => guarded(() => {
      this.lost = false;
      this.open();
      byId('message').hidden = true;
      byId('panel').hidden = false;
      this.changed();
    }));
  }

  choose(level, normals) {
    [this.level, this.normals] = [level, normals];
    byId('level').value = level;
    byId('normals').value = normals;
    this.changed();
  }

  // Something else is to be seen: a coarse picture in the next frame, and finer ones when it rests.
  changed() {
    this.version++;
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => this.next().catch(failed));
  }

  async next() {
    const { version } = this;
    try {
      if (this.lost) return;
      this.fit();
      const started = performance.now();
      await this.whole(this.factor);
      const took = performance.now() - started;
      this.factor = Math.min(COARSEST, Math.max(1, this.factor * Math.sqrt(took / FRAME) * 0.5 + this.factor * 0.5));
    } finally {
      this.waiting = false;
    }
    clearTimeout(this.timer);
    if (this.version !== version) this.changed();
    else this.timer = setTimeout(() => this.refine(version).catch(failed), REST);
  }

  fit() {
    const ratio = Math.min(2, devicePixelRatio || 1);
    const width = Math.max(1, Math.round(this.canvas.clientWidth * ratio)), height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    // The shape stands in the middle of what the panel leaves free.
    const free = height - ratio * (byId('panel').offsetHeight + 24);
    this.camera = { ...this.orbit.camera(width, Math.max(height / 2, free)), height };
  }

  grid(factor) {
    return resized(this.camera, Math.max(1, Math.round(this.camera.width / factor)), Math.max(1, Math.round(this.camera.height / factor)));
  }

  wanted() {
    return { level: this.level, normalLevel: this.normals, colored: this.shading > 2 };
  }

  // The whole picture at once, in rays of `factor` pixels.
  async whole(factor) {
    const grid = this.grid(factor);
    const started = performance.now();
    const seen = await this.renderer.frame(grid, this.wanted());
    this.speed = (grid.width * grid.height) / Math.max(1, performance.now() - started);
    this.keep('coarse', grid, seen, 0, grid.height);
    this.ready = 0;
    this.fine = this.fine ?? { ...this.coarse, borrowed: true };
    this.present();
    this.report(grid, false);
  }

  // Finer and finer, strip by strip, until something else is to be seen.
  async refine(version) {
    for (let factor = 2 ** Math.floor(Math.log2(this.factor) - 1e-9); factor >= this.finest; factor /= 2) {
      const grid = this.grid(factor);
      this.keep('fine', grid, null, 0, 0);
      for (let first = 0; first < grid.height;) {
        await new Promise((resolve) => { setTimeout(resolve, 0); });
        if (this.version !== version || this.lost || document.hidden) return;
        const rows = Math.min(grid.height - first, Math.max(1, Math.floor((STRIP * this.speed) / grid.width)));
        const started = performance.now();
        const seen = await this.renderer.frame(grid, { ...this.wanted(), first, rows });
        if (this.version !== version || this.lost) return;
        // Empty strips are quick; the next may not be.
        this.speed = Math.min(1.5 * this.speed, (grid.width * rows) / Math.max(1, performance.now() - started));
        this.keep('fine', grid, seen, first, rows);
        first += rows;
        this.ready = first;
        this.present();
        this.report(grid, first < grid.height);
      }
      [this.coarse, this.fine] = [this.fine, this.coarse];
      this.ready = 0;
    }
    document.documentElement.dataset.finished = this.drawn;
  }

  // Rows of a picture into its textures: what is seen, and its colours, of which a picture without them has one texel.
  keep(name, grid, made, first, rows) {
    const { gl } = this;
    const colored = this.shading > 2;
    const held = this[name];
    if (!held || held.borrowed || held.width !== grid.width || held.height !== grid.height || held.colored !== colored) {
      if (held && !held.borrowed) for (const texture of [held.texture, held.color]) gl.deleteTexture(texture);
      const { width, height } = grid;
      this[name] = { width, height, colored, texture: texture2d(gl, width, height), color: texture2d(gl, colored ? width : 1, colored ? height : 1) };
      if (this.fine?.borrowed) this.fine = null;
    }
    if (!made) return;
    gl.activeTexture(gl.TEXTURE0);
    for (const [texture, numbers] of [[this[name].texture, made.seen], [this[name].color, made.color]]) {
      if (!numbers.length) continue;
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, first, grid.width, rows, gl.RGBA, gl.FLOAT, numbers);
    }
  }

  present() {
    const { gl, shade, camera } = this;
    if (this.lost || !this.coarse) return;
    document.documentElement.dataset.drawn = ++this.drawn;
    const { paper, clay } = THEMES[this.theme];
    gl.useProgram(shade.program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, camera.width, camera.height);
    const planes = { fine: this.fine.texture, coarse: this.coarse.texture, fineColor: this.fine.color, coarseColor: this.coarse.color };
    Object.entries(planes).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(shade.at(name), unit);
    });
    gl.uniform1i(shade.at('ready'), this.ready);
    gl.uniform1i(shade.at('shading'), this.shading);
    gl.uniform2f(shade.at('size'), camera.width, camera.height);
    gl.uniformMatrix3fv(shade.at('axes'), false, [...camera.right, ...camera.down, ...camera.forward]);
    gl.uniform4f(shade.at('lens'), camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform3f(shade.at('paper'), ...paper);
    gl.uniform3f(shade.at('clay'), ...clay);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  report(grid, more) {
    byId('state').textContent = `${grid.width} × ${grid.height} rays${more ? ' …' : ''}`;
  }

  // One picture of any camera, for tests and for other scripts: arrays of its pixels, and what they have cost.
  async render({ camera, level = this.level, normalLevel = level, precision = null, colored = false }) {
    this.renderer.clear();
    const started = performance.now();
    const made = await this.renderer.frame(camera, { level, normalLevel, precision, colored });
    return { ...made, milliseconds: performance.now() - started, counts: this.renderer.counts() };
  }

  // Pictures of a camera that goes around, one in each frame: how many in a second, and what one costs.
  async bench({ size = 512, frames = 12, level = this.level } = {}) {
    const orbit = new Orbit(this.saved.header.view);
    let milliseconds = 0, operations = 0, passes = 0, read = 0;
    const evaluations = this.renderer.counts().values.map(() => 0);
    for (let frame = 0; frame < frames; frame++) {
      await new Promise((resolve) => { setTimeout(resolve, 0); });
      orbit.azimuth = (360 * frame) / frames;
      const { counts, milliseconds: took } = await this.render({ camera: orbit.camera(size, size), level });
      milliseconds += took / frames;
      passes += counts.passes / frames;
      read += counts.read / frames;
      operations += this.renderer.operations(counts) / frames;
      evaluations.forEach((_, index) => { evaluations[index] += (counts.values[index] + counts.jets[index]) / frames / size ** 2; });
    }
    return { size, level, frames, fps: 1000 / milliseconds, milliseconds, evaluations, passes, read, operations };
  }

  describeBench({ size, level, fps, evaluations, passes, read, operations }) {
    const each = evaluations.map(digits).join(' + ');
    byId('facts').textContent = `level ${level} at ${size} × ${size}: ${digits(fps)} pictures a second; ${each} evaluations per pixel, ${digits(operations / 1e9)} GFLOP, ${digits(passes)} passes, ${digits(read / 2 ** 20)} MiB read back, each picture`;
  }
}

const failed = (error) => tell(error instanceof PageError ? error.message : `Something went wrong in this page: ${error.message}`);

function guarded(work) {
  try {
    work();
  } catch (error) {
    failed(error);
  }
}

addEventListener('DOMContentLoaded', () => guarded(() => {
  const text = (id) => byId(id)?.textContent ?? '';
  const parts = new Map(text('shaders').split('#part ').slice(1).map((part) => {
    const end = part.indexOf('\n');
    return [part.slice(0, end), part.slice(end)];
  }));
  const page = new Page(decodeField(text('header'), text('data')), parts);
  window.mplicits = { render: (wanted) => page.render(wanted), bench: (wanted) => page.bench(wanted), get renderer() { return page.renderer; }, header: page.saved.header };
  const wanted = new URLSearchParams(location.search);
  if (wanted.has('bench')) {
    const size = Math.min(1024, Math.max(16, Number(wanted.get('bench')) || 512));
    page.bench({ size }).then((found) => page.describeBench(found)).catch(failed);
  }
}));
