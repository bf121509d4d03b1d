// Live input: weights that the program hears over UDP (VMC, OSC) and hands on over a WebSocket.
import { INDEX, NAMES } from "./shapes.js";

export class Live {
  // heard(weights, head): head is [x, y, z, w] or null; told(text) of the connection
  constructor(heard, told) {
    this.heard = heard;
    this.told = told;
    this.socket = null;
    this.count = 0;
  }

  get active() {
    return this.socket !== null;
  }

  start() {
    const address = new URL("live", location.href);
    address.protocol = "ws:";
    const socket = new WebSocket(address);
    this.socket = socket;
    this.weights = new Float32Array(NAMES.length);
    socket.onmessage = (event) => {
      const message = JSON.parse(event.data);
      if (message.told) { this.told(message.told); return; }
      for (const [name, value] of Object.entries(message.weights ?? {}))
        if (name in INDEX) this.weights[INDEX[name]] = Math.min(Math.max(value, 0), 1);
      this.count += 1;
      this.heard(this.weights, message.head ?? null);
    };
    socket.onclose = () => {
      if (this.socket === socket) { this.socket = null; this.told(null); }
    };
  }

  stop() {
    const { socket } = this;
    this.socket = null;
    socket?.close();
  }
}
