"use strict";
// What the page carries: a header in JSON, and bytes that it describes. All errors are sentences for people.

class PageError extends Error {}

// CRC-32 as in zip files; crypto.subtle is not there for pages from a disk in every browser.
function checksum(bytes) {
  const table = new Uint32Array(256);
  for (let n = 0; n < 256; n++) {
    let c = n;
    for (let k = 0; k < 8; k++) c = c & 1 ? 0xedb88320 ^ (c >>> 1) : c >>> 1;
    table[n] = c;
  }
  let crc = 0xffffffff;
  for (const byte of bytes) crc = table[(crc ^ byte) & 255] ^ (crc >>> 8);
  return (crc ^ 0xffffffff) >>> 0;
}

// Bytes that were deflated; none of damaged ones.
async function inflated(bytes) {
  try {
    return new Uint8Array(await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate-raw'))).arrayBuffer());
  } catch {
    return new Uint8Array(0);
  }
}

// The header and the arrays of a page; what is cut off, changed or of another kind is refused.
async function decodeField(headerText, packed) {
  let header;
  try {
    header = JSON.parse(headerText);
  } catch {
    throw new PageError('This page is not complete. Copy it again, or write it again with `mplicits web`.');
  }
  if (header?.format !== 'mplicits-web') throw new PageError('The data in this page is no field of mplicits.');
  if (header.version !== 2) throw new PageError(`The field in this page is of version ${header.version}; this page reads 2.`);
  const bytes = await inflated(packed);
  if (bytes.length !== header.bytes || checksum(bytes) !== header.crc32) {
    throw new PageError('The field in this page is damaged or cut off. Copy the page again, or write it again with `mplicits web`.');
  }
  const arrays = new Map();
  for (const [name, [kind, count, start]] of Object.entries(header.blocks)) {
    arrays.set(name, numbersOf(bytes, kind, count, start));
  }
  return { header, arrays };
}

function numbersOf(bytes, kind, count, start) {
  if (kind === 'f4') return new Float32Array(bytes.buffer, start, count);
  if (kind === 'u1') return new Uint8Array(bytes.buffer, start, count);
  if (kind === 'u2') return new Uint16Array(bytes.buffer, start, count);
  if (kind === 'u4') return new Uint32Array(bytes.buffer, start, count);
  // Signed codes: the upper eight bits of each, then the lower ones without gaps; of kind d, what each adds to the last.
  const bits = Number(kind.slice(1)), low = Math.max(0, bits - 8), places = 2 ** low;
  const numbers = new Int32Array(count);
  let held = 0, pool = 0, at = start + count, last = 0;
  for (let i = 0; i < count; i++) {
    while (held < low) {
      pool += bytes[at++] * 2 ** held;
      held += 8;
    }
    const code = bytes[start + i] * places + (pool % places);
    last = (kind[0] === 'd' ? last : 0) + (code >= 2 ** (bits - 1) ? code - 2 ** bits : code);
    numbers[i] = last;
    pool = Math.floor(pool / places);
    held -= low;
  }
  return numbers;
}

// The networks of a field, as they are counted: its levels, then its colours.
const networksOf = ({ levels, colors }) => [...levels, ...(colors ? [colors] : [])];

// The layers of a network: weights row by row, out x in.
function layersOf(arrays, { name, depth }) {
  const layers = [];
  for (let index = 0; index <= depth; index++) {
    const key = `${name}.${index}`;
    const bias = arrays.get(`${key}.bias`), scale = arrays.get(`${key}.scale`), codes = arrays.get(`${key}.weight`);
    let weight = codes;
    if (scale) {
      const columns = codes.length / bias.length;
      weight = Float32Array.from(codes, (code, i) => code * scale[Math.floor(i / columns)]);
    }
    layers.push({ weight, bias, rate: arrays.get(`${key}.rate`) });
  }
  return layers;
}
