// What moves the camera and changes what is seen: pointers, fingers, keys, and the controls of the panel.

const TAP = 5; // pixels that a pointer may move between down and up, and still mean a place
const PASSAGE = 4; // seconds from the first moment to the last

class Controls {
  constructor(page) {
    this.page = page;
    this.ui = page.ui;
    this.tools = page.tools;
    this.held = new Map();
    this.fill();
    this.themes();
    this.panel();
    this.pointers();
    this.keys();
  }

  // What the field has: levels, colours, moments; again when another takes its place.
  fill() {
    const { ui, page } = this;
    const { levels, colors, shapes, moves } = page.saved.header, { last } = page;
    ui.level.max = last;
    ui.levels.hidden = !last;
    ui.normals.replaceChildren(...levels.map((_, index) => new Option(index === last ? `${index} (finest)` : index, index)));
    ui.normals.parentNode.hidden = !last;
    for (const option of [...ui.shading.options]) if (option.value > 2) option.remove();
    if (colors || page.painted) ui.shading.prepend(new Option('bare colours', 4));
    if (colors) ui.shading.prepend(new Option('colours', 3));
    const names = [...(levels.length ? [FIELD] : []), ...shapes.map(({ name }) => name)];
    ui.parts.replaceChildren(...(names.length > 1 ? names.map((name) => this.part(name)) : []));
    ui.times.hidden = !moves;
    if (moves) ui.saveFilm.textContent = 'Save film';
    this.show();
  }

  // A box that shows or hides the field, a cloud or a mesh.
  part(name) {
    const { page } = this, box = make('input', { type: 'checkbox' });
    box.checked = !page.hidden.includes(name);
    box.addEventListener('change', () => {
      page.hidden = page.hidden.filter((other) => other !== name).concat(box.checked ? [] : [name]);
      page.changed();
    });
    return make('label', {}, box, ` ${name}`);
  }

  // Light or dark, as the system is.
  themes() {
    const bright = matchMedia('(prefers-color-scheme: light)');
    this.setTheme(bright.matches ? 'light' : 'dark');
    bright.addEventListener('change', () => {
      this.setTheme(bright.matches ? 'light' : 'dark');
      this.page.present();
    }, this.heard);
  }

  // Listeners on what outlives the page end with it.
  get heard() {
    return { signal: this.page.ended.signal };
  }

  // The controls as the page is.
  show() {
    const { ui, page } = this;
    ui.level.value = page.level;
    ui.levelName.textContent = page.level;
    ui.normals.value = page.normals;
    ui.shading.value = page.shading;
    ui.occlusion.checked = page.occlusion;
    ui.time.value = page.time;
    ui.timeName.textContent = page.time.toFixed(2);
    ui.axis.value = page.section.axis ?? -1;
    ui.place.hidden = ui.placeName.hidden = page.section.axis === null;
    if (page.section.axis === null) return;
    const { unit, center } = page.saved.header, { axis, at } = page.section;
    ui.placeName.textContent = digits(at * unit + center[axis]);
  }

  // The slice: its axis and place, as the controls have them.
  slice() {
    const { ui, page } = this, axis = Number(ui.axis.value);
    page.section.choose(axis < 0 ? null : axis, Number(ui.place.value));
    this.show();
    page.changed();
  }

  // Something that takes a while; one at a time.
  async save(button, work) {
    const { ui } = this;
    if (this.saving) return;
    this.saving = true;
    button.disabled = true;
    try {
      await work();
    } catch (error) {
      ui.state.textContent = error instanceof PageError ? error.message : `Not saved: ${error.message}`;
    } finally {
      this.saving = button.disabled = false;
    }
  }

  // Forth and back through time, as long as nobody stops it.
  play(on = !this.playing) {
    const { page, ui } = this;
    this.playing = on && page.saved.header.moves;
    ui.play.textContent = this.playing ? 'Pause' : 'Play';
    let before = null, share = this.back ? 2 - page.time : page.time;
    const step = (now) => {
      if (!this.playing || page.ended.signal.aborted) return;
      if (before !== null) {
        // A tab in the background stands still; nothing is skipped when it comes back.
        share = (share + Math.min(200, now - before) / 1000 / PASSAGE) % 2;
        this.back = share > 1;
        page.setTime(this.back ? 2 - share : share);
        this.show();
      }
      before = now;
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  setTheme(name) {
    this.page.theme = this.ui.stage.dataset.theme = name;
  }

  choose(level, normals) {
    Object.assign(this.page, { level, normals });
    this.show();
    this.page.changed();
  }

  panel() {
    const { ui, page } = this;
    ui.level.addEventListener('input', () => this.choose(Number(ui.level.value), Number(ui.level.value)));
    ui.normals.addEventListener('change', () => this.choose(page.level, Number(ui.normals.value)));
    ui.shading.addEventListener('change', () => {
      page.shading = Number(ui.shading.value);
      if (page.shading > 2) page.changed();
      else page.present();
    });
    ui.occlusion.addEventListener('change', () => { page.occlusion = ui.occlusion.checked; page.present(); });
    ui.place.value = 0.5;
    ui.axis.addEventListener('change', () => this.slice());
    ui.place.addEventListener('input', () => this.slice());
    ui.play.addEventListener('click', () => this.play());
    ui.time.addEventListener('input', () => {
      this.play(false);
      page.setTime(Number(ui.time.value));
      this.show();
    });
    ui.ruler.addEventListener('click', () => this.tools.toggleRuler());
    const { title } = page.saved.header;
    ui.savePicture.addEventListener('click', () => this.save(ui.savePicture, async () => {
      await page.rested();
      download(await savedPicture(page), fileName(title, 'png'));
    }));
    ui.saveFilm.addEventListener('click', () => this.save(ui.saveFilm, async () => {
      const { blob, ending } = await turntable(page);
      download(blob, fileName(title, ending));
    }));
    ui.reset.addEventListener('click', () => { page.orbit.reset(); page.changed(); });
    ui.theme.addEventListener('click', () => { this.setTheme(page.theme === 'dark' ? 'light' : 'dark'); page.present(); });
    ui.panel.addEventListener('submit', (event) => event.preventDefault());
    document.addEventListener('visibilitychange', () => { if (!document.hidden) page.changed(); }, this.heard);
  }

  pointers() {
    const { page, held } = this, { canvas, orbit } = page;
    const share = () => Math.min(canvas.clientWidth, canvas.clientHeight);
    canvas.addEventListener('pointerdown', (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.down = held.size ? null : [event.offsetX, event.offsetY]; // two fingers mean no place
      this.tools.leave();
      held.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener('pointermove', (event) => {
      if (!held.has(event.pointerId)) {
        this.tools.hover(event.offsetX, event.offsetY);
        return;
      }
      if (this.down && Math.hypot(event.offsetX - this.down[0], event.offsetY - this.down[1]) <= TAP) return;
      this.down = null;
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
      page.changed();
    });
    canvas.addEventListener('pointerup', () => {
      if (this.down) this.tools.tap(...this.down).catch((error) => this.ui.failed(error));
      this.down = null;
    });
    canvas.addEventListener('pointerleave', () => this.tools.leave());
    for (const end of ['pointerup', 'pointercancel', 'lostpointercapture']) canvas.addEventListener(end, (event) => held.delete(event.pointerId));
    canvas.addEventListener('contextmenu', (event) => event.preventDefault());
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      const lines = event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? event.deltaY / 30 : event.deltaY;
      orbit.zoom(1.08 ** -Math.max(-8, Math.min(8, lines)));
      page.changed();
    }, { passive: false });
  }

  keys() {
    const { page } = this, { orbit } = page;
    page.canvas.addEventListener('keydown', (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const move = (x, y) => (event.shiftKey ? orbit.pan(x / 20, y / 20) : orbit.turn(6 * x, 6 * y));
      const keys = {
        ArrowLeft: () => move(-1, 0), ArrowRight: () => move(1, 0), ArrowUp: () => move(0, -1), ArrowDown: () => move(0, 1),
        '+': () => orbit.zoom(1.15), '=': () => orbit.zoom(1.15), '-': () => orbit.zoom(1 / 1.15), Home: () => orbit.reset(),
        ' ': () => this.play(),
        Backspace: () => this.tools.landmarks?.undo(),
        r: () => this.tools.toggleRuler(), Escape: () => this.tools.toggleRuler(false),
        Enter: () => this.tools.tap(page.canvas.clientWidth / 2, page.canvas.clientHeight / 2).catch((error) => this.ui.failed(error)),
      };
      const level = Number(event.key);
      if (keys[event.key]) keys[event.key]();
      else if (event.key.trim() && level < page.saved.header.levels.length) this.choose(level, level);
      else return;
      event.preventDefault();
      page.changed();
    });
  }
}
