// A page that `mplicits view` serves: each new checkpoint of the run takes the place of the one before, from where you stand.

function follow(page) {
  let have = String(page.saved.header.crc32), last = Promise.resolve();
  const source = new EventSource('live');
  source.onopen = () => { page.ui.told.live = 'yes'; };
  source.onmessage = ({ data }) => {
    if (data === have) return;
    have = data;
    last = last.then(async () => page.adopt(await splitFile(await (await fetch('field.bin')).arrayBuffer()))).catch((error) => page.ui.failed(error));
  };
  source.onerror = () => { // the browser asks again by itself
    page.ui.told.live = 'no';
    page.ui.state.textContent = 'The server has ended. What is here stays.';
  };
}

// Pairs of the same point of two shapes that stand side by side, left and right of the middle; the server keeps them.
class Landmarks {
  constructor(page, { names, pairs }) {
    Object.assign(this, { page, names, pairs, pending: [null, null] });
    page.tools.landmarks = this;
    const undo = make('button', { id: 'undo', type: 'button' }, 'Undo landmark');
    undo.addEventListener('click', () => this.undo());
    page.ui.ruler.after(undo);
    this.tell();
  }

  // A place of the picture's scene. Clicks of a pair come in any order; a second one on the same shape replaces the first.
  pick(place) {
    this.pending[Number(place[0] >= 0)] = place;
    if (this.pending.every(Boolean)) {
      this.pairs.push(this.pending);
      this.pending = [null, null];
      this.keep();
    }
    this.tell();
  }

  undo() {
    if (this.pending.some(Boolean)) this.pending = [null, null];
    else if (this.pairs.pop()) this.keep();
    this.tell();
  }

  get marks() {
    return [...this.pairs, this.pending].flatMap((pair, index) => pair.filter(Boolean).map((place) => ({ number: index + 1, place })));
  }

  tell() {
    const { length, state } = this.page.ui, side = this.pending.findIndex(Boolean), number = this.pairs.length + 1;
    length.hidden = false;
    length.textContent = side < 0
      ? `Landmark ${number}: click on ${this.names[0]} (left) and on the same point of ${this.names[1]} (right)`
      : `Landmark ${number}: now click on ${this.names[1 - side]} (${['right', 'left'][side]})`;
    state.textContent = `${this.pairs.length} pairs`;
    this.page.present();
  }

  keep() {
    fetch('landmarks', { method: 'POST', body: JSON.stringify(this.pairs) }).then(async (answer) => {
      if (!answer.ok) throw new PageError(await answer.text());
    }).catch((error) => { this.page.ui.state.textContent = `Not kept: ${error.message}`; });
  }
}

begun.then((page) => {
  if (!page) return;
  if (page.saved.header.landmarks) new Landmarks(page, page.saved.header.landmarks);
  else follow(page);
});
