// The first picture: head and eyes at rest, their albedo in the light of the surroundings and the key, without shadow,
// relief or details. Its shader is a few lines, so that it is seen while the full one is loaded and compiled.
import { THREE, GLTFLoader } from "./three.js";
import { ENVIRONMENTS, harmonics } from "./environment.js";

const VERTEX = `
  varying vec3 facing;
  varying vec2 place;
  void main() {
    vec4 seen = modelMatrix * vec4(position, 1.0);
    facing = mat3(modelMatrix) * normal;
    place = uv;
    gl_Position = projectionMatrix * viewMatrix * seen;
  }`;
const FRAGMENT = `
  varying vec3 facing;
  varying vec2 place;
  uniform sampler2D map;
  uniform vec3 surroundings[9], key_direction, key_light;
  uniform mat3 turned;
  void main() {
    vec3 n = normalize(facing), d = turned * n;
    vec3 light = surroundings[0] + surroundings[1] * d.x + surroundings[2] * d.y + surroundings[3] * d.z
      + surroundings[4] * d.x * d.y + surroundings[5] * d.x * d.z + surroundings[6] * d.y * d.z
      + surroundings[7] * (d.x * d.x - d.y * d.y) + surroundings[8] * (3.0 * d.z * d.z - 1.0);
    light = max(light, 0.02) + key_light * max(dot(n, key_direction), 0.0);
    gl_FragColor = vec4(texture2D(map, place).rgb * light, 1.0);
    #include <tonemapping_fragment>
    #include <colorspace_fragment>
  }`;

const material = (surface, map) => new THREE.ShaderMaterial({
  uniforms: { ...surface.shared, map: { value: map } }, vertexShader: VERTEX, fragmentShader: FRAGMENT,
});

function plain(colour) {
  const texture = new THREE.DataTexture(Uint8Array.from([...colour.toArray(), 1], (x) => 255 * x), 1, 1);
  const linear = { minFilter: THREE.LinearMipmapLinearFilter, magFilter: THREE.LinearFilter, generateMipmaps: true };
  return Object.assign(texture, linear, { colorSpace: THREE.SRGBColorSpace, needsUpdate: true });
}

// Sets the light, and draws a speck, so that the shader is compiled while first.glb is still on its way.
export function prepare(stage, surface) {
  const { studio } = ENVIRONMENTS;
  studio.harmonics ??= harmonics(studio);
  surface.setSurroundings(studio, studio.harmonics, 1);
  const { direction, light } = studio.key;
  surface.setKey(new THREE.Vector3(...direction).normalize(), new THREE.Vector3().setScalar(light), stage.centre);
  const speck = new THREE.BufferGeometry();
  for (const [name, size] of [["position", 3], ["normal", 3], ["uv", 2]])
    speck.setAttribute(name, new THREE.BufferAttribute(Float32Array.from({ length: 3 * size }, (_, i) => 1e-4 * (i % 4)), size));
  speck.setIndex(new THREE.BufferAttribute(Uint16Array.of(0, 1, 2), 1));
  const mesh = new THREE.Mesh(speck, material(surface, plain(new THREE.Color(0))));
  mesh.frustumCulled = false;
  stage.scene.add(mesh);
  stage.draw();
  stage.scene.remove(mesh);
}

// file: first.glb as an ArrayBuffer. What is drawn, to be taken away when the full avatar is there.
export async function firstPicture(file, stage, surface) {
  const { scene } = await new GLTFLoader().parseAsync(file, "");
  scene.traverse((node) => {
    if (node.isMesh) node.material = material(surface, node.material.map ?? plain(node.material.color));
  });
  stage.scene.add(scene);
  stage.redraw();
  return scene;
}
