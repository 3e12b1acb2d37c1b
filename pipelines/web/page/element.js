// <mplicits-field src="field.bin">: a field in any page, in a tree of its own, so that neither page's styles meet.

async function fetched(address, signal) {
  let answer;
  try {
    answer = await fetch(address, { signal });
  } catch (error) {
    if (error.name === 'AbortError') throw error;
    throw new PageError(`${address} could not be fetched. A page from a disk may not: serve the folder, or use index.html.`);
  }
  if (!answer.ok) throw new PageError(`${address} could not be fetched: the server says ${answer.status}.`);
  return answer.arrayBuffer();
}

class MplicitsField extends HTMLElement {
  static observedAttributes = ['src', 'camera', 'level'];

  constructor() {
    super();
    const root = this.attachShadow({ mode: 'open' });
    const sheet = new CSSStyleSheet(); // made by script: a policy on styles does not mean it
    sheet.replaceSync(`:host { display: block; position: relative; min-height: 240px; } :host([hidden]) { display: none; }\n${STYLE}`);
    root.adoptedStyleSheets = [sheet];
    root.append(make('div', { id: 'stage' }));
  }

  connectedCallback() {
    this.load();
  }

  disconnectedCallback() {
    this.end();
  }

  attributeChangedCallback(name, before, value) {
    if (!this.isConnected || before === value) return;
    if (name === 'src') this.load();
    else if (this.page) this.apply();
  }

  end() {
    this.asked?.abort();
    this.page?.close();
    this.page = null;
    delete this.dataset.drawn;
    delete this.dataset.finished;
  }

  async load() {
    this.end();
    const asked = this.asked = new AbortController(), src = this.getAttribute('src');
    const ui = new Interface(this.shadowRoot.getElementById('stage'));
    try {
      if (!src) throw new PageError('This element has no field: <mplicits-field src="field.bin"> names one.');
      const saved = await splitFile(await fetched(new URL(src, document.baseURI).href, asked.signal));
      if (asked.signal.aborted) return;
      this.page = new Page(saved, shaderParts(SHADERS), ui);
      this.apply();
      this.dispatchEvent(new Event('load'));
    } catch (error) {
      if (asked.signal.aborted) return;
      ui.failed(error);
      this.dispatchEvent(new ErrorEvent('error', { message: error.message, error }));
    }
  }

  // What the attributes wish: camera="AZIMUTH,ELEVATION", level="N".
  apply() {
    const { page } = this, { camera } = wishes(new URLSearchParams({ camera: this.getAttribute('camera') ?? '' }));
    if (camera) Object.assign(page.orbit, { azimuth: camera[0], elevation: Math.min(90, Math.max(-90, camera[1])) });
    const level = Number(this.getAttribute('level') ?? NaN);
    if (Number.isInteger(level) && level >= 0 && level < page.saved.header.levels.length) page.controls.choose(level, level);
    else page.changed();
  }

  get header() {
    return this.page?.saved.header ?? null;
  }

  get renderer() {
    return this.page?.renderer ?? null;
  }

  ready() {
    if (!this.page) throw new PageError('The field is not there yet: wait for the element\'s "load".');
    return this.page;
  }

  async render(wanted) {
    return this.ready().render(wanted);
  }

  async bench(wanted) {
    return this.ready().bench(wanted);
  }

  async turntable(wanted) {
    return turntable(this.ready(), wanted);
  }
}

if (!customElements.get('mplicits-field')) customElements.define('mplicits-field', MplicitsField);

export { MplicitsField };
