// A page of its own: the field lies in it.

const shaderParts = (text) => new Map(text.split('#part ').slice(1).map((part) => {
  const end = part.indexOf('\n');
  return [part.slice(0, end), part.slice(end)];
}));

// What the address wishes: ?camera=AZIMUTH,ELEVATION&pixel=N
function wishes(search) {
  const given = (search.get('camera') ?? '').split(',').map(Number);
  const camera = search.has('camera') && given.length === 2 && given.every(Number.isFinite) ? given : null;
  return { camera, pixel: Number(search.get('pixel')) };
}

addEventListener('DOMContentLoaded', () => {
  const text = (id) => document.getElementById(id)?.textContent ?? '';
  const ui = new Interface(document.getElementById('stage'));
  ui.guarded(() => {
    const search = new URLSearchParams(location.search);
    const saved = decodeField(text('header'), bytesOf(text('data')));
    document.title = saved.header.title;
    const page = new Page(saved, shaderParts(text('shaders')), ui, wishes(search));
    window.mplicits = { render: (wanted) => page.render(wanted), bench: (wanted) => page.bench(wanted), turntable: (wanted) => turntable(page, wanted), get renderer() { return page.renderer; }, header: saved.header };
    if (search.has('bench')) {
      const size = Math.min(1024, Math.max(16, Number(search.get('bench')) || 512));
      page.bench({ size }).then((found) => page.describeBench(found)).catch((error) => ui.failed(error));
    }
  });
});
