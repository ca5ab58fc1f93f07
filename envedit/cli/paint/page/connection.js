// The WebSocket: JSON both ways, frames from the server; reconnects by itself.

const KINDS = ["render", "map", "difference", "unreachable", "before", "explanation", "sky", "sky-before", "photograph"];
const SOURCES = ["transport", "mitsuba", "saved"];

export class Connection {
  constructor(on) {
    this.on = on;
    this.wait = 250;
    this.open();
  }

  open() {
    const address = new URL("ws", location.href);
    address.protocol = "ws:";
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => { this.wait = 250; };
    this.socket.onmessage = (event) => {
      if (typeof event.data === "string") this.on.message(JSON.parse(event.data));
      else this.on.frame(unpacked(event.data));
    };
    this.socket.onclose = () => {
      this.on.lost();
      setTimeout(() => this.open(), this.wait);
      this.wait = Math.min(2 * this.wait, 4000);
    };
  }

  send(message) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }
}

function unpacked(buffer) {
  const head = new DataView(buffer, 0, 16);
  return {
    kind: KINDS[head.getUint8(4)],
    source: SOURCES[head.getUint8(5)],
    width: head.getUint16(6, true),
    height: head.getUint16(8, true),
    number: head.getUint32(10, true),
    view: head.getUint16(14, true),
    pixels: new Uint16Array(buffer, 16),
  };
}
