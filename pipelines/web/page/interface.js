// What stands around the picture: built here node by node, for a page of its own as for an element in another's.

function make(tag, attributes = {}, ...inside) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...inside);
  return node;
}

const HELP = 'The shape. Drag or use the arrow keys to turn it, plus and minus to come nearer.';

// Every node that has an id is a property of that name.
class Interface {
  constructor(stage) {
    const label = (text, ...nodes) => make('label', {}, `${text} `, ...nodes);
    const button = (id, text) => make('button', { id, type: 'button' }, text);
    const range = (id, max, step, name) => make('input', { id, type: 'range', min: 0, max, step, value: 0, 'aria-label': name });
    const tools = make('details', { id: 'tools' }, make('summary', {}, 'Tools'), make('div', {},
      label('Normals of level', make('select', { id: 'normals' })),
      make('label', {}, make('input', { id: 'occlusion', type: 'checkbox' }), ' Occlusion'),
      make('span', { class: 'row' },
        label('Slice', make('select', { id: 'axis' }, ...['none', 'x', 'y', 'z'].map((name, index) => new Option(name, index - 1)))),
        range('place', 1, 'any', 'Place of the slice'), make('output', { id: 'placeName' })),
      make('span', { id: 'parts', class: 'row' }),
      make('button', { id: 'ruler', type: 'button', 'aria-pressed': false }, 'Ruler'),
      button('savePicture', 'Save picture'),
      button('saveFilm', 'Save turntable'),
      button('reset', 'Reset view'),
      button('theme', 'Light or dark'),
    ));
    stage.replaceChildren(
      make('canvas', { id: 'picture', tabindex: 0, 'aria-label': HELP }),
      make('canvas', { id: 'marks', 'aria-hidden': true }),
      make('header', {}, make('h1', { id: 'title' }), make('p', { id: 'facts' }),
        make('output', { id: 'length', hidden: '' }), make('output', { id: 'reading', hidden: '' })),
      make('form', { id: 'panel', hidden: '' },
        make('label', { id: 'levels' }, 'Level ', range('level', 0, 1, 'Level of detail'), make('output', { id: 'levelName' })),
        make('span', { id: 'times', class: 'row', hidden: '' }, button('play', 'Play'), range('time', 1, 'any', 'Time'), make('output', { id: 'timeName' })),
        label('Shading', make('select', { id: 'shading' },
          new Option('light', 2), new Option('matcap', 0), new Option('normals', 1))),
        tools,
        make('output', { id: 'state' })),
      make('div', { id: 'message', role: 'alert', hidden: '' }, make('p', { id: 'reason' })),
    );
    this.stage = stage;
    for (const node of stage.querySelectorAll('[id]')) this[node.id] = node;
  }

  // Where the page says how far it is, for scripts: the element, or the document.
  get told() {
    return (this.stage.getRootNode().host ?? document.documentElement).dataset;
  }

  tell(reason) {
    this.reason.textContent = reason;
    this.message.hidden = false;
    this.panel.hidden = true;
  }

  carryOn() {
    this.message.hidden = true;
    this.panel.hidden = false;
  }

  failed(error) {
    this.tell(error instanceof PageError ? error.message : `Something went wrong in this page: ${error.message}`);
  }

  guarded(work) {
    try {
      work();
    } catch (error) {
      this.failed(error);
    }
  }
}
