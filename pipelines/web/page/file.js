// A field as a file of its own: what an element fetches, and what a live page is sent.

const MAGIC = 'mplicits-field\n';

// A file of a folder: the magic, the length of the header, the header, bytes.
function splitFile(buffer) {
  const bytes = new Uint8Array(buffer), text = new TextDecoder();
  if (text.decode(bytes.subarray(0, MAGIC.length)) !== MAGIC) throw new PageError('This file is no field of mplicits. `mplicits web RUN -o FOLDER` writes field.bin.');
  if (bytes.length < MAGIC.length + 4) throw new PageError('This file is cut off. Copy it again.');
  const start = MAGIC.length + 4, length = new DataView(buffer).getUint32(MAGIC.length, true);
  const body = bytes.slice(Math.min(bytes.length, start + length)); // copied, so that its numbers are aligned
  return decodeField(text.decode(bytes.subarray(start, start + length)), body);
}
