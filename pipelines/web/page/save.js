// Pictures and films for the disk. Nothing leaves the page but as a download.

const TURN_FRAMES = 96, TURN_RATE = 24, TURN_SIDE = 720; // of a turntable; pixels of its shorter side at most
const CODER_PATIENCE = 20000; // ms
const FILMS = [['video/webm;codecs=vp9', 'webm'], ['video/webm', 'webm'], ['video/mp4', 'mp4']];

// A name that every system takes.
const fileName = (title, ending) => `${title.replace(/[^\p{L}\p{N}._-]+/gu, '_').replace(/^[._]+|[._]+$/g, '').slice(0, 80) || 'field'}.${ending}`;

function download(blob, name) {
  const address = URL.createObjectURL(blob);
  make('a', { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 60000);
}

// What is on the canvas, with the marks over it. It has to be drawn anew: the browser has taken the last one.
async function savedPicture(page) {
  const { width, height } = page.canvas;
  page.present();
  const sheet = Object.assign(document.createElement('canvas'), { width, height });
  const pen = sheet.getContext('2d');
  pen.drawImage(page.canvas, 0, 0);
  pen.drawImage(page.ui.marks, 0, 0);
  return new Promise((resolve) => { sheet.toBlob(resolve, 'image/png'); });
}

// Pictures, one after the other at a steady rate, as a film; a film takes as long to record as to see. A coder starts in its
// own time, and drops what it holds when it is stopped: so the first picture stands until it gives what it coded (of two
// pieces the second is no mere header), and the last one until two more have come.
async function recorded(pictures, rate) {
  const [type, ending] = FILMS.find(([kind]) => globalThis.MediaRecorder?.isTypeSupported(kind)) ?? [];
  if (!type) throw new PageError('This browser records no films. Save pictures instead.');
  const { width, height } = pictures[0];
  const sheet = Object.assign(document.createElement('canvas'), { width, height });
  const pen = sheet.getContext('2d');
  pen.drawImage(pictures[0], 0, 0);
  const stream = sheet.captureStream();
  const recorder = new MediaRecorder(stream, { mimeType: type, videoBitsPerSecond: 8e6 });
  const parts = [];
  recorder.addEventListener('dataavailable', ({ data }) => { if (data.size) parts.push(data); });
  const ended = new Promise((resolve) => { recorder.addEventListener('stop', resolve); });
  const until = (moment) => new Promise((resolve) => { setTimeout(resolve, Math.max(0, moment - performance.now())); });
  const stand = async (picture, wanted) => {
    const latest = performance.now() + CODER_PATIENCE;
    while (parts.length < wanted) {
      if (performance.now() > latest) throw new PageError('The browser coded no film in time. Try again, or save pictures.');
      pen.drawImage(picture, 0, 0);
      await until(performance.now() + 1000 / rate);
    }
  };
  recorder.start(1000 / rate);
  try {
    await stand(pictures[0], 2);
    const started = performance.now();
    for (const [index, picture] of pictures.entries()) {
      await until(started + (1000 * index) / rate);
      pen.drawImage(picture, 0, 0);
    }
    await stand(pictures.at(-1), parts.length + 2);
  } finally {
    recorder.stop();
    stream.getTracks().forEach((track) => track.stop());
  }
  await ended;
  return { blob: new Blob(parts, { type }), ending };
}

// Pictures of the shape as it stands, once around; of one that moves, from its first moment to the last. Then all is where
// it was. What moves the camera meanwhile ends it.
async function turntable(page, { frames = TURN_FRAMES, side = TURN_SIDE, rate = TURN_RATE } = {}) {
  const { orbit, ui } = page, { azimuth } = orbit, { time } = page, { moves } = page.saved.header;
  page.controls.play(false);
  const shorter = Math.min(page.canvas.width, page.canvas.height), factor = Math.min(1, side / shorter);
  const even = (number) => Math.max(2, 2 * Math.round((number * factor) / 2)); // as coders of films want it
  const [width, height] = [even(page.canvas.width), even(page.canvas.height)];
  const pictures = [];
  try {
    for (let frame = 0; frame < frames; frame++) {
      if (moves) {
        page.time = frame / Math.max(1, frames - 1);
        page.section.version++;
      } else orbit.azimuth = azimuth + (360 * frame) / frames;
      if (!await page.still(width, height)) throw new PageError('The film was broken off.');
      pictures.push(await createImageBitmap(page.canvas));
      ui.state.textContent = `picture ${frame + 1} of ${frames}`;
    }
    return await recorded(pictures, rate);
  } finally {
    pictures.forEach((picture) => picture.close());
    orbit.azimuth = azimuth;
    page.setTime(time);
  }
}
