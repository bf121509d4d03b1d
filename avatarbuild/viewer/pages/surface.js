// Materials of the parts, their common uniforms, the light.
import { THREE } from "./three.js";

const LOBES = 6;
const ROUGHNESS = { head: 0.5, eye_left: 0.1, eye_right: 0.1, teeth_upper: 0.25, teeth_lower: 0.25, gums: 0.34, tongue: 0.42 };

export class Surface {
  constructor() {
    const three = (count) => Array.from({ length: count }, () => new THREE.Vector3());
    this.shared = {
      surroundings: { value: three(9) },
      lobe_axis: { value: three(LOBES) },
      lobe_light: { value: three(LOBES) },
      lobes: { value: 0 },
      lobe_sharpness: { value: new Array(LOBES).fill(1) },
      sky: { value: three(3) },
      turned: { value: new THREE.Matrix3() },
      key_direction: { value: new THREE.Vector3(0, 0, 1) },
      key_light: { value: new THREE.Vector3() },
      clay: { value: new THREE.Vector3(0.36, 0.36, 0.365) },
      mouth: { value: new THREE.Vector3(0, -1, 0.001) },
      head_axes: { value: new THREE.Matrix3() },
      show_albedo: { value: true },
      show_details: { value: true },
      show_occlusion: { value: true },
      show_relief: { value: true },
      show_normals: { value: false },
      show_skin_light: { value: true },
    };
    this.eyeCentres = { eye_left: { value: new THREE.Vector3() }, eye_right: { value: new THREE.Vector3() } };
    this.wire = new THREE.MeshBasicMaterial({ wireframe: true, color: 0x9fd0ff, transparent: true, opacity: 0.35 });
    this.wire.polygonOffset = true;
    this.key = new THREE.DirectionalLight(0xffffff, 1);
    const { shadow } = this.key;
    this.key.castShadow = true;
    shadow.mapSize.set(1024, 1024);
    Object.assign(shadow.camera, { left: -0.2, right: 0.2, top: 0.2, bottom: -0.2, near: 0.1, far: 1.1 });
    shadow.radius = 3.2;
    shadow.bias = -0.0004;
    shadow.normalBias = 0.0016;
  }

  // sources: GLSL { vertex, fragment, synthesis }; details: of the expression, or null
  use(sources, details) {
    this.sources = sources;
    this.details = details;
  }

  material(mesh) {
    const own = mesh.material, part = mesh.name;
    const kind = part === "head" ? "SKIN" : part.startsWith("eye") ? "EYE" : "MOUTH";
    const uniforms = {
      ...THREE.UniformsUtils.clone(THREE.UniformsLib.lights),
      ...this.shared,
      map: { value: own.map ?? plain(255 * own.color.r, 255 * own.color.g, 255 * own.color.b) },
      roughness: { value: ROUGHNESS[part] ?? own.roughness ?? 0.5 },
    };
    if (uniforms.map.value.isTexture) uniforms.map.value.anisotropy = 8;
    const defines = { [kind]: "" };
    let vertex = this.sources.vertex, fragment = this.sources.fragment;
    if (kind === "EYE") uniforms.eye_centre = this.eyeCentres[part] ?? { value: new THREE.Vector3() };
    if (kind === "SKIN") {
      uniforms.normal_map = { value: own.normalMap ?? plain(128, 128, 255) };
      uniforms.occlusion_map = { value: own.aoMap ?? plain(255, 255, 255) };
      uniforms.normal_map.value.anisotropy = 4;
      prepare(mesh.geometry);
      if (this.details) {
        Object.assign(defines, this.details.defines);
        Object.assign(uniforms, this.details.uniforms);
        this.details.attach(mesh.geometry.attributes.uv);
        fragment = `precision highp sampler2DArray;\n#define DETAIL_LAYERS\n${this.sources.synthesis}\n${fragment}`;
      }
    }
    const made = new THREE.ShaderMaterial({
      name: part, uniforms, defines, vertexShader: vertex, fragmentShader: fragment, lights: true, toneMapped: true,
    });
    if (kind === "SKIN") this.skin = made;
    return made;
  }

  setMouth(y, z, gap) {
    this.shared.mouth.value.set(y, z, gap);
  }

  setHead(head, eyes) {
    for (const eye of eyes) eye.getWorldPosition(this.eyeCentres[eye.name].value);
    this.shared.head_axes.value.setFromMatrix4(head.matrixWorld).transpose();
  }

  // environment: sky, lamps, key of environment.js, and its harmonics y (9, 3); `strength` scales all but the key
  setSurroundings(environment, y, strength) {
    const s = this.shared;
    y.forEach((row, j) => s.surroundings.value[j].fromArray(row).multiplyScalar(strength));
    environment.sky.forEach((row, j) => s.sky.value[j].fromArray(row).multiplyScalar(strength));
    s.lobes.value = Math.min(environment.lamps.length, LOBES);
    for (let i = 0; i < LOBES; i++) {
      const lamp = environment.lamps[i];
      s.lobe_axis.value[i].fromArray(lamp?.axis ?? [0, 1, 0]);
      s.lobe_light.value[i].fromArray(lamp?.radiance ?? [0, 0, 0]).multiplyScalar(strength);
      s.lobe_sharpness.value[i] = lamp?.sharpness ?? 1;
    }
  }

  turnSurroundings(radians) {
    this.shared.turned.value.setFromMatrix4(new THREE.Matrix4().makeRotationY(-radians));
  }

  setKey(direction, light, centre) {
    this.shared.key_direction.value.copy(direction);
    this.shared.key_light.value.copy(light);
    this.key.target.position.copy(centre);
    this.key.position.copy(centre).addScaledVector(direction, 0.6);
    this.key.target.updateMatrixWorld();
    this.key.updateMatrixWorld();
  }
}

// what an older file may lack
function prepare(geometry) {
  if (!geometry.attributes.tangent) geometry.computeTangents();
  if (!geometry.attributes.traits)
    {
    const none = new Uint8Array(4 * geometry.attributes.position.count);
    for (let i = 3; i < none.length; i += 4) none[i] = 255; // far from the rim
    geometry.setAttribute("traits", new THREE.BufferAttribute(none, 4, true));
  }
}

function plain(r, g, b) {
  const texture = new THREE.DataTexture(new Uint8Array([r, g, b, 255]), 1, 1);
  texture.needsUpdate = true;
  return texture;
}
