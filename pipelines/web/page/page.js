// The page: its pictures, when they are traced, and how fine. Whatever comes from the run is put in as text, never as HTML.

const COARSEST = 16, FINEST = 0.5; // canvas pixels per ray
const FRAME = 40, STRIP = 60, REST = 180; // milliseconds: of a picture while it moves, of a strip, before it is refined
const STRIPS = 12; // of a picture, at most

const digits = (number) => Number(number.toPrecision(3)).toLocaleString('en', { maximumSignificantDigits: 3 });

// The parts of the shaders, by their names.
const shaderParts = (text) => new Map(text.split('#part ').slice(1).map((part) => {
  const end = part.indexOf('\n');
  return [part.slice(0, end), part.slice(end)];
}));

// What an address wishes, or an element: camera=AZIMUTH,ELEVATION and pixel=N.
function wishes(search) {
  const given = (search.get('camera') ?? '').split(',').map(Number);
  const camera = search.has('camera') && given.length === 2 && given.every(Number.isFinite) ? given : null;
  return { camera, pixel: Number(search.get('pixel')) };
}

class Page {
  // A field, its shaders, where it is shown; and what is wished: {camera: [azimuth, elevation], pixel}.
  constructor(saved, parts, ui, { camera = null, pixel = 0 } = {}) {
    this.parts = parts;
    this.ui = ui;
    this.ended = new AbortController();
    this.canvas = ui.picture;
    this.context();
    this.take(saved);
    ({ saved } = this);
    this.orbit = new Orbit(saved.header.view);
    if (camera) Object.assign(this.orbit, { azimuth: camera[0], elevation: Math.min(90, Math.max(-90, camera[1])) });
    this.level = this.normals = this.last;
    this.time = 0;          // of a field that moves, from 0 to 1
    this.waiters = [];      // for the finest picture
    this.occlusion = true;
    this.section = new Section(saved.header);
    this.hidden = saved.header.shapes.filter(({ hidden }) => hidden).map(({ name }) => name);
    this.shading = saved.header.colors ? 3 : 2; // 3 is colours in light, 4 bare colours
    this.factor = COARSEST; // canvas pixels per ray while it moves; less as soon as the adapter shows how fast it is
    this.speed = 200;     // pixels per millisecond
    this.finest = pixel > 0 ? Math.min(COARSEST, Math.max(FINEST, pixel)) : FINEST; // coarser at rest, for slow adapters
    this.drawn = 0;       // pictures so far
    this.version = 0;     // of what is to be seen; a refinement of an older one ends
    this.open();
    this.describe();
    this.tools = new Tools(this);
    this.controls = new Controls(this);
    this.watch();
    ui.carryOn();
    this.changed();
  }

  // A context of the adapter.
  context() {
    const gl = this.canvas.getContext('webgl2', { antialias: false, depth: false, alpha: false, powerPreference: 'high-performance' });
    if (!gl) throw new PageError('This browser has no WebGL 2, with which the page draws. Any current Chrome, Edge, Firefox or Safari has, if graphics acceleration is not switched off.');
    if (!gl.getExtension('EXT_color_buffer_float')) {
      throw new PageError('This graphics adapter cannot draw into float textures (EXT_color_buffer_float), in which the page computes. Another device can.');
    }
    this.gl = gl;
  }

  // What of a field the adapter can hold.
  take(field) {
    const { saved, left } = fitting(field, this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE));
    Object.assign(this, { saved, left });
  }

  get last() {
    return Math.max(0, this.saved.header.levels.length - 1);
  }

  // Whether there are colours beside those of a field's network.
  get painted() {
    return this.saved.header.shapes.some(({ colored }) => colored);
  }

  // All that is in the context; again after it was lost.
  open() {
    this.renderer = openRenderer(this.gl, this.parts, this.saved);
    this.section.forget();
    this.paint = new Paint(this.gl, this.parts);
  }

  // Another field in the place of this one, seen from where this one was: a run that has grown. The finest level stays the
  // finest, any other what it was.
  async adopt(field) {
    const { saved, left } = fitting(field, this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE));
    const renderer = openRenderer(this.gl, this.parts, saved);
    await renderer.open();
    if (this.lost) return renderer.close();
    const before = this.renderer, finest = this.last;
    const { axis, at } = this.section;
    this.section.drop();
    Object.assign(this, { saved, left, renderer, section: new Section(saved.header) });
    Object.assign(this.section, { axis, at });
    before.close();
    const { last } = this;
    this.level = this.level === finest ? last : Math.min(this.level, last);
    this.normals = this.normals === finest ? last : Math.min(this.normals, last);
    this.shading = Math.min(this.shading, saved.header.colors || this.painted ? 4 : 2);
    this.describe();
    this.controls.fill();
    this.version++;
    clearTimeout(this.timer);
    return this.changed();
  }

  describe() {
    const { header } = this.saved;
    this.ui.title.textContent = header.title;
    const shown = header.shapes.map(({ name, kind, count }) => `${name}: ${count.toLocaleString('en')} ${kind}`);
    if (!header.levels.length) {
      this.ui.facts.textContent = shown.join(' · ');
      return;
    }
    const sizes = header.levels.map(({ width, depth }) => `${width} × ${depth}`).join(', ');
    const bands = header.deltas.length ? ` · bands δ = ${header.deltas.map((delta) => digits(delta * header.unit)).join(', ')} input units` : '';
    const exact = header.bits === null
      ? 'weights in float32'
      : `weights of ${header.bits} bits: off by ≤ ${digits(Math.max(...header.rounding.map((part) => part.value)) * header.unit)} units, ${digits(Math.max(...header.rounding.map((part) => part.angle)))}°`;
    this.ui.facts.textContent = [`${this.left}SIRENs ${sizes}${bands}`, exact, ...shown].join(' · ');
  }

  // The size of the canvas, and the adapter, may change under us.
  watch() {
    const { canvas, ui } = this;
    const seen = new ResizeObserver(() => this.changed());
    seen.observe(canvas);
    this.ended.signal.addEventListener('abort', () => seen.disconnect());
    canvas.addEventListener('webglcontextlost', (event) => {
      event.preventDefault(); // or it would never come back
      this.version++;
      this.lost = true;
      ui.tell('The graphics adapter was taken away from this page. It goes on as soon as it is back; if nothing happens, reload the page.');
    });
    canvas.addEventListener('webglcontextrestored', () => ui.guarded(() => {
      this.lost = false;
      this.context();
      this.open();
      ui.carryOn();
      this.changed();
    }));
  }

  // For good: the adapter's memory is given back.
  close() {
    this.ended.abort();
    this.version++;
    this.lost = true;
    clearTimeout(this.timer);
    this.gl.getExtension('WEBGL_lose_context')?.loseContext();
  }

  // Something else is to be seen: a coarse picture in the next frame, and finer ones when it rests.
  changed() {
    this.version++;
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => this.next().catch((error) => this.ui.failed(error)));
  }

  async next() {
    const { version } = this;
    try {
      if (this.lost) return;
      this.fit();
      await this.renderer.at(this.time);
      await this.section.refresh(this.gl, this.renderer, this.level);
      const started = performance.now();
      await this.whole(this.factor);
      const took = performance.now() - started;
      this.factor = Math.min(COARSEST, Math.max(1, this.factor * Math.sqrt(took / FRAME) * 0.5 + this.factor * 0.5));
    } finally {
      this.waiting = false;
    }
    clearTimeout(this.timer);
    if (this.version !== version) this.changed();
    else this.timer = setTimeout(() => this.refine(version).catch((error) => this.ui.failed(error)), REST);
  }

  setTime(time) {
    this.time = time;
    this.section.version++; // its values are of another moment
    this.changed();
  }

  fit() {
    const ratio = Math.min(2, devicePixelRatio || 1);
    const width = Math.max(1, Math.round(this.canvas.clientWidth * ratio)), height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    // The shape stands in the middle of what title and panel leave free, if that is most of it.
    const above = ratio * (this.ui.facts.getBoundingClientRect().bottom - this.canvas.getBoundingClientRect().top);
    const free = height - above - ratio * (this.ui.panel.offsetHeight + 24);
    const camera = this.orbit.camera(width, Math.max(height / 2, free));
    this.camera = { ...camera, height, cy: camera.cy + (free > height / 2 ? above : 0) };
  }

  grid(factor) {
    return resized(this.camera, Math.max(1, Math.round(this.camera.width / factor)), Math.max(1, Math.round(this.camera.height / factor)));
  }

  wanted() {
    const { level, normals, hidden, time } = this;
    return { level, normalLevel: normals, colored: this.shading > 2 && this.renderer.colored, clip: this.section.clip, hidden, time };
  }

  // Whether pictures have colours of their own.
  get colored() {
    return this.wanted().colored || this.saved.header.shapes.length > 0;
  }

  // The whole picture at once, in rays of `factor` pixels.
  async whole(factor) {
    const grid = this.grid(factor);
    const started = performance.now();
    const seen = await this.renderer.frame(grid, this.wanted());
    this.speed = (grid.width * grid.height) / Math.max(1, performance.now() - started);
    this.paint.whole(grid, seen);
    this.present();
    this.report(grid, false);
  }

  // Finer and finer, strip by strip, until something else is to be seen.
  async refine(version) {
    if (await this.section.refresh(this.gl, this.renderer, this.level, true)) this.present();
    for (let factor = 2 ** Math.floor(Math.log2(this.factor) - 1e-9); factor >= this.finest; factor /= 2) {
      const grid = this.grid(factor);
      this.paint.begin(grid, this.colored);
      for (let first = 0; first < grid.height;) {
        await new Promise((resolve) => { setTimeout(resolve, 0); });
        if (this.version !== version || this.lost || document.hidden) return;
        const rows = Math.min(grid.height - first, this.strip(grid));
        const started = performance.now();
        const seen = await this.renderer.frame(grid, { ...this.wanted(), first, rows });
        if (this.version !== version || this.lost) return;
        // Empty strips are quick; the next may not be.
        this.speed = Math.min(1.5 * this.speed, (grid.width * rows) / Math.max(1, performance.now() - started));
        this.paint.add(grid, seen, first, rows);
        first += rows;
        this.present();
        this.report(grid, first < grid.height);
      }
      this.paint.complete();
    }
    this.ui.told.finished = this.drawn;
    this.waiters.splice(0).forEach((resolve) => resolve());
  }

  // Rows that can be traced at a time. Thin strips cost what their passes cost, and a slow adapter would seem slower still
  // by them, so that there are never more than `STRIPS`.
  strip({ width, height }) {
    return Math.max(Math.ceil(height / STRIPS), Math.floor((STRIP * this.speed) / width));
  }

  // When the picture is as fine as it gets.
  rested() {
    if (Number(this.ui.told.finished) === this.drawn) return Promise.resolve();
    return new Promise((resolve) => { this.waiters.push(resolve); });
  }

  // A whole picture of that many pixels on the canvas, one ray each; false if something else came in between.
  async still(width, height) {
    const version = ++this.version;
    clearTimeout(this.timer);
    Object.assign(this.canvas, { width, height });
    const camera = this.orbit.camera(width, height);
    await this.renderer.at(this.time);
    await this.section.refresh(this.gl, this.renderer, this.level);
    const { colored } = this, size = 4 * width * height;
    const made = { seen: new Float32Array(size), color: new Float32Array(colored ? size : 0) };
    for (let first = 0; first < height;) {
      await new Promise((resolve) => { setTimeout(resolve, 0); });
      const rows = Math.min(height - first, this.strip(camera));
      const started = performance.now();
      const { seen, color } = await this.renderer.frame(camera, { ...this.wanted(), first, rows });
      if (this.version !== version || this.lost) return false;
      this.speed = Math.min(1.5 * this.speed, (width * rows) / Math.max(1, performance.now() - started));
      made.seen.set(seen, 4 * width * first);
      made.color.set(color, 4 * width * first);
      first += rows;
    }
    this.camera = camera;
    this.paint.whole(camera, made);
    this.present();
    return true;
  }

  present() {
    if (this.lost || !this.paint.coarse) return;
    this.ui.told.drawn = ++this.drawn;
    this.paint.present(this.camera, this);
    this.tools.draw();
  }

  report(grid, more) {
    this.ui.state.textContent = `${grid.width} × ${grid.height} rays${more ? ' …' : ''}`;
  }

  // One picture of any camera, for tests and for other scripts: arrays of its pixels, and what they have cost.
  render({ camera, level = this.level, normalLevel = level, precision = null, colored = false, hidden = this.hidden, time = this.time }) {
    return this.renderer.frame(camera, { level, normalLevel, precision, colored, hidden, time });
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
    this.ui.facts.textContent = `level ${level} at ${size} × ${size}: ${digits(fps)} pictures a second; ${each} evaluations per pixel, ${digits(operations / 1e9)} GFLOP, ${digits(passes)} passes, ${digits(read / 2 ** 20)} MiB read back, each picture`;
  }
}
