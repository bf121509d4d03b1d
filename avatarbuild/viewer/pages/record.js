// Pictures and clips of what the canvas shows, saved by the browser.

export function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

// draw() has just filled the canvas in this very task
export function picture(canvas, draw) {
  draw();
  return new Promise((done, fault) =>
    canvas.toBlob((blob) => (blob ? done(blob) : fault(new Error("the browser gives no picture"))), "image/png"));
}

const KINDS = ["video/mp4;codecs=avc1.640028", "video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm", "video/mp4"];

export class Recorder {
  constructor(canvas) {
    this.canvas = canvas;
    this.recorder = null;
  }

  get active() {
    return this.recorder !== null;
  }

  // A promise of the clip, kept when stop() is called.
  start() {
    const kind = globalThis.MediaRecorder && KINDS.find((type) => MediaRecorder.isTypeSupported(type));
    if (!kind) throw new Error("this browser cannot record clips");
    const stream = this.canvas.captureStream(60), parts = [];
    this.recorder = new MediaRecorder(stream, { mimeType: kind, videoBitsPerSecond: 12_000_000 });
    this.recorder.ondataavailable = (event) => { if (event.data.size) parts.push(event.data); };
    const ended = new Promise((done) => {
      this.recorder.onstop = () => {
        stream.getTracks().forEach((track) => track.stop());
        this.recorder = null;
        done({ blob: new Blob(parts, { type: kind }), suffix: kind.startsWith("video/mp4") ? "mp4" : "webm" });
      };
    });
    this.recorder.start(250);
    return ended;
  }

  stop() {
    if (this.recorder?.state === "recording") this.recorder.stop();
  }
}
