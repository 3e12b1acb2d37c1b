// A page that `mplicits view` serves: each new checkpoint of the run takes the place of the one before, from where you stand.

const AGAIN = 2000, AT_MOST = 30000; // milliseconds before a lost server is asked again, doubled each time

function follow(page) {
  let wait = AGAIN, last = Promise.resolve();
  const listen = () => {
    const address = new URL('live', location.href);
    address.protocol = address.protocol.replace('http', 'ws');
    address.search = `have=${page.saved.header.crc32}`;
    const socket = new WebSocket(address);
    socket.binaryType = 'arraybuffer';
    socket.onopen = () => {
      wait = AGAIN;
      page.ui.told.live = 'yes';
    };
    socket.onmessage = ({ data }) => {
      last = last.then(() => splitFile(data)).then((saved) => page.adopt(saved)).catch((error) => page.ui.failed(error));
    };
    socket.onclose = () => {
      page.ui.told.live = 'no';
      page.ui.state.textContent = 'The server has ended. What is here stays.';
      setTimeout(listen, wait);
      wait = Math.min(AT_MOST, 2 * wait);
    };
  };
  listen();
}

begun.then((page) => {
  if (page) follow(page);
  else document.getElementById('reason').append(' The command `mplicits view RUN --stream` draws where it runs, without a graphics adapter here.');
});
