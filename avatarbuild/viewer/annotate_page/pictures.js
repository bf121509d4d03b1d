// Pictures by their address: the last ones are kept, the rest is asked for again.

export class Pictures {
  constructor(most, ready) {
    this.most = most;
    this.ready = ready;
    this.kept = new Map();
  }

  get(address) {
    let image = this.kept.get(address);
    if (image) {
      this.kept.delete(address); // to the end: the last used
    } else {
      image = new Image();
      image.onload = () => this.ready();
      image.src = address;
    }
    this.kept.set(address, image);
    if (this.kept.size > this.most) this.kept.delete(this.kept.keys().next().value);
    return image.complete && image.naturalWidth ? image : null;
  }
}
