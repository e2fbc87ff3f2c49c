// A window on an image: which of its places is in the middle, and how many of the screen's pixels one of its pixels is.

const MOST = 64 // of the screen's pixels for one of the image
const STEP = 1.25

export class Viewport {
  centre = [0, 0]
  zoom = 1
  size = [1, 1] // of the window, in the screen's pixels
  image = [1, 1]

  toScreen([x, y]) {
    return [(x - this.centre[0]) * this.zoom + this.size[0] / 2, (y - this.centre[1]) * this.zoom + this.size[1] / 2]
  }

  toImage([u, v]) {
    return [(u - this.size[0] / 2) / this.zoom + this.centre[0], (v - this.size[1] / 2) / this.zoom + this.centre[1]]
  }

  get least() {
    return Math.min(this.size[0] / this.image[0], this.size[1] / this.image[1])
  }

  get isWhole() {
    return this.zoom <= this.least * 1.001
  }

  fit() {
    this.zoom = this.least
    this.centre = this.image.map((length) => (length - 1) / 2)
  }

  show(centre, zoom = this.zoom) {
    this.zoom = Math.min(Math.max(zoom, this.least / 2), MOST)
    this.centre = centre.map((value, k) => Math.min(Math.max(value, -0.5), this.image[k] - 0.5))
  }

  pan(dx, dy) {
    this.show([this.centre[0] - dx / this.zoom, this.centre[1] - dy / this.zoom])
  }

  // What is under the pointer stays there.
  zoomAt(steps, at = this.size.map((length) => length / 2)) {
    const before = this.toImage(at)
    this.show(this.centre, this.zoom * STEP ** steps)
    const after = this.toImage(at)
    this.show([this.centre[0] + before[0] - after[0], this.centre[1] + before[1] - after[1]])
  }

  // The part of the image that is seen, in pixels from its outer corner: left, top, right, bottom; null for none.
  get seen() {
    const corner = this.toImage([0, 0]).map((value) => Math.max(value + 0.5, 0))
    const opposite = this.toImage(this.size).map((value, k) => Math.min(value + 0.5, this.image[k]))
    return opposite[0] > corner[0] && opposite[1] > corner[1] ? [...corner, ...opposite] : null
  }
}
