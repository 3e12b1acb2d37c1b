// The page's script and shaders are deflated, as they would be the larger part of a small page. The policy at the head of
// the page names the digest of the script, so that no other text would run.

// The bytes of a block of the page: 13 bits, lowest first, in two of 91 letters; the last may be 6 bits in one.
function bytesOf(text) {
  const letters = text.trim(), pairs = letters.length >> 1, odd = letters.length & 1;
  const digit = (i) => {
    const code = letters.charCodeAt(i);
    return code - 33 - (code > 34) - (code > 38) - (code > 60);
  };
  const bytes = new Uint8Array(Math.floor((13 * pairs + 6 * odd) / 8));
  let pool = 0, held = 0, at = 0;
  for (let pair = 0; pair < pairs + odd; pair++) {
    pool |= (digit(2 * pair) + (pair < pairs ? 91 * digit(2 * pair + 1) : 0)) << held;
    for (held += pair < pairs ? 13 : 6; held >= 8; held -= 8) {
      bytes[at++] = pool & 255;
      pool >>>= 8;
    }
  }
  return bytes;
}

(async () => {
  const code = bytesOf(document.getElementById('code').textContent);
  const text = await new Response(new Blob([code]).stream().pipeThrough(new DecompressionStream('deflate-raw'))).text();
  const [shaders, script] = text.split('\0');
  document.getElementById('shaders').textContent = shaders;
  document.body.append(Object.assign(document.createElement('script'), { textContent: script }));
})().catch(() => {
  document.getElementById('reason').textContent = 'This page is damaged, or this browser cannot unpack it (DecompressionStream). Any current Chrome, Edge, Firefox or Safari can.';
});
