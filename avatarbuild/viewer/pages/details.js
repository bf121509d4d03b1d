// Details of the current expression: files of avatar/details -> textures and uniforms of synthesis.glsl.
//
// How far the keyframes are is drawn into a small texture, a texel a vertex, when the expression has changed, and not for
// every picture and pass: that is most of the details' work.
import { THREE } from "./three.js";

const WIDTH = 256; // texels of a row of the texture of vertices
const SLOT = 0; // the one uniform block of the page; an unbound program's blocks read from slot 0

async function picture(address) {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error(`${address}: ${answer.status}`);
  // bytes as they are: no colour space, no alpha, no flip
  return createImageBitmap(await answer.blob(), { colorSpaceConversion: "none", premultiplyAlpha: "none" });
}

export async function loadDetails(folder, renderer, synthesis) {
  const answer = await fetch(`${folder}/details.json`);
  if (!answer.ok) throw new Error(`details.json: ${answer.status}`);
  const about = await answer.json();
  if (about.version !== 1) throw new Error(`details.json has version ${about.version}, 1 is needed`);
  const [positions, ...weights] = await Promise.all(
    [about.positions.file, ...about.weights.map((row) => row.file)].map((name) => picture(`${folder}/${name}`)),
  );
  return new Details(about, positions, weights, renderer, synthesis);
}

class Details {
  constructor(about, positions, weights, renderer, synthesis) {
    this.renderer = renderer;
    this.synthesis = synthesis;
    this.about = about;
    this.keyframes = about.keyframes.length;
    this.edges = about.edges.length;
    this.gl = renderer.getContext();
    this.defines = { KEYFRAMES: this.keyframes, EDGES: this.edges, QUARTETS: Math.ceil(this.keyframes / 4), ROW: WIDTH };
    const at = (values) => values.map((v) => new THREE.Vector3(...v));
    this.distances = {
      detail_positions: { value: positionTexture(positions) },
      detail_low: { value: at(about.positions.low_mm) },
      detail_step: { value: at(about.positions.step_mm) },
      detail_beta: { value: about.beta_per_mm },
    };
    this.uniforms = {
      quartets: { value: [] },
      detail_weights: { value: weightTexture(weights, about.side) },
      detail_scale: { value: at(about.weights.map((row) => row.scale)) },
      detail_centre: { value: about.keyframes.map((key) => key.centre) },
    };
    this.block = new Float32Array(8 * this.keyframes * this.edges);
    about.keyframes.forEach((key, k) => key.ends_mm.forEach((ends, e) => {
      const length = Math.hypot(ends[0] - ends[3], ends[1] - ends[4], ends[2] - ends[5]);
      this.block.set([...ends.slice(0, 3), length], 4 * (k * this.edges + e));
      this.block.set(ends.slice(3), 4 * (this.keyframes * this.edges + k * this.edges + e));
    }));
    const { gl } = this;
    this.buffer = gl.createBuffer();
    gl.bindBuffer(gl.UNIFORM_BUFFER, this.buffer);
    gl.bufferData(gl.UNIFORM_BUFFER, this.block, gl.DYNAMIC_DRAW);
    gl.bindBuffer(gl.UNIFORM_BUFFER, null);
    gl.bindBufferBase(gl.UNIFORM_BUFFER, SLOT, this.buffer);
    this.setStrain(new Float64Array(this.edges));
  }

  // uv: the texture coordinates of the skin's vertices, whose distances are wanted
  attach(uv) {
    const rows = Math.ceil(uv.count / WIDTH), places = new Float32Array(2 * WIDTH * rows);
    for (let i = 0; i < uv.count; i++) places.set([uv.getX(i), uv.getY(i)], 2 * i);
    const texture = new THREE.DataTexture(places, WIDTH, rows, THREE.RGFormat, THREE.FloatType);
    texture.needsUpdate = true;
    const count = this.defines.QUARTETS;
    const type = this.renderer.extensions.has("EXT_color_buffer_float") ? THREE.FloatType : THREE.HalfFloatType;
    this.target = new THREE.WebGLRenderTarget(WIDTH, rows, {
      count, type, format: THREE.RGBAFormat, minFilter: THREE.NearestFilter, magFilter: THREE.NearestFilter, depthBuffer: false,
    });
    this.uniforms.quartets.value = this.target.textures;
    const outs = Array.from({ length: count }, (_, i) => {
      const parts = [0, 1, 2, 3].map((j) => (4 * i + j < this.keyframes ? `phi[${4 * i + j}]` : "0.0"));
      return [`layout(location = ${i}) out vec4 quartet_${i};`, `quartet_${i} = vec4(${parts.join(", ")});`];
    });
    const material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      defines: this.defines,
      uniforms: { ...this.distances, places: { value: texture } },
      vertexShader: "in vec3 position; void main() { gl_Position = vec4(position, 1.0); }",
      fragmentShader: `precision highp float; precision highp int; precision highp sampler2D;
        #define DETAIL_DISTANCES
        ${this.synthesis}
        uniform sampler2D places;
        ${outs.map(([declared]) => declared).join("\n")}
        void main() {
          float phi[KEYFRAMES];
          detail_distances(texelFetch(places, ivec2(gl_FragCoord.xy), 0).xy, phi);
          ${outs.map(([, set]) => set).join("\n")}
        }`,
      depthTest: false,
      depthWrite: false,
    });
    const sheet = new THREE.BufferGeometry();
    sheet.setAttribute("position", new THREE.BufferAttribute(new Float32Array([-1, -1, 0, 3, -1, 0, -1, 3, 0]), 3));
    const mesh = new THREE.Mesh(sheet, material);
    mesh.frustumCulled = false;
    this.sheet = new THREE.Scene();
    this.sheet.add(mesh);
    this.eye = new THREE.Camera();
  }

  // draws the distances where the strain is another than the last time
  refresh() {
    if (!this.stale) return;
    this.stale = false;
    this.renderer.setRenderTarget(this.target);
    this.renderer.render(this.sheet, this.eye);
    this.renderer.setRenderTarget(null);
  }

  // strain: of every edge; ((f_e - f_ke) / spread_e)^2 of every keyframe is all that an expression changes
  setStrain(strain) {
    const { about, block, gl } = this;
    const first = 4 * this.keyframes * this.edges;
    for (let e = 0; e < this.edges; e++) {
      const held = Math.min(Math.max(strain[e], about.strain_low[e]), about.strain_high[e]);
      for (let k = 0; k < this.keyframes; k++) {
        const d = (held - about.keyframes[k].strain[e]) / about.strain_spread[e];
        block[first + 4 * (k * this.edges + e) + 3] = d * d;
      }
    }
    gl.bindBuffer(gl.UNIFORM_BUFFER, this.buffer);
    gl.bufferSubData(gl.UNIFORM_BUFFER, 0, block);
    gl.bindBuffer(gl.UNIFORM_BUFFER, null);
    this.stale = true;
  }
}

function positionTexture(image) {
  const texture = new THREE.Texture(image);
  texture.colorSpace = THREE.NoColorSpace;
  texture.flipY = false;
  texture.premultiplyAlpha = false;
  texture.generateMipmaps = false;
  texture.minFilter = texture.magFilter = THREE.NearestFilter;
  texture.needsUpdate = true;
  return texture;
}

function weightTexture(images, side) {
  const data = new Uint8Array(4 * side * side * images.length);
  const canvas = new OffscreenCanvas(side, side);
  const context = canvas.getContext("2d", { willReadFrequently: true, colorSpace: "srgb" });
  images.forEach((image, j) => {
    context.drawImage(image, 0, 0); // opaque pictures: the canvas gives their bytes back unchanged
    data.set(context.getImageData(0, 0, side, side).data, 4 * side * side * j);
  });
  const texture = new THREE.DataArrayTexture(data, side, side, images.length);
  texture.colorSpace = THREE.NoColorSpace;
  texture.minFilter = THREE.LinearMipmapLinearFilter;
  texture.magFilter = THREE.LinearFilter;
  texture.generateMipmaps = true;
  texture.needsUpdate = true;
  return texture;
}
