// A page of its own: the field lies in it.

async function start() {
  const text = (id) => document.getElementById(id)?.textContent ?? '';
  const ui = new Interface(document.getElementById('stage'));
  try {
    const search = new URLSearchParams(location.search);
    const saved = await decodeField(text('header'), bytesOf(text('data')));
    document.title = saved.header.title;
    const page = new Page(saved, shaderParts(text('shaders')), ui, wishes(search));
    window.mplicits = { render: (wanted) => page.render(wanted), bench: (wanted) => page.bench(wanted), turntable: (wanted) => turntable(page, wanted), get renderer() { return page.renderer; }, get header() { return page.saved.header; } };
    if (search.has('bench')) {
      const size = Math.min(1024, Math.max(16, Number(search.get('bench')) || 512));
      page.bench({ size }).then((found) => page.describeBench(found)).catch((error) => ui.failed(error));
    }
    return page;
  } catch (error) {
    ui.failed(error);
    return null;
  }
}

// The script runs as soon as it is unpacked; the data behind it may not all be there yet.
const loaded = new Promise((resolve) => {
  if (document.readyState === 'loading') addEventListener('DOMContentLoaded', resolve);
  else resolve();
});
const begun = loaded.then(start);
