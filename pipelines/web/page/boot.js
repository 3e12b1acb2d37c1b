// The page's script and shaders are deflated, as they would be the larger part of a small page. The policy at the head of
// the page names the digest of the script, so that no other text would run.
(async () => {
  const code = Uint8Array.from(atob(document.getElementById('code').textContent), (letter) => letter.charCodeAt(0));
  const text = await new Response(new Blob([code]).stream().pipeThrough(new DecompressionStream('deflate-raw'))).text();
  const [shaders, script] = text.split('\0');
  document.getElementById('shaders').textContent = shaders;
  document.body.append(Object.assign(document.createElement('script'), { textContent: script }));
})().catch(() => {
  document.getElementById('reason').textContent = 'This page is damaged, or this browser cannot unpack it (DecompressionStream). Any current Chrome, Edge, Firefox or Safari can.';
});
