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

// file: first.glb as an ArrayBuffer. What is drawn, to be taken away when the full avatar is there.
export async function firstPicture(file, stage, surface) {
  const { scene } = await new GLTFLoader().parseAsync(file, "");
  scene.traverse((node) => {
    if (!node.isMesh) return;
    const { map, color } = node.material;
    const value = map ?? new THREE.DataTexture(Uint8Array.from([...color.toArray(), 1], (x) => 255 * x), 1, 1);
    value.needsUpdate = true;
    node.material = new THREE.ShaderMaterial({
      uniforms: { ...surface.shared, map: { value } }, vertexShader: VERTEX, fragmentShader: FRAGMENT,
    });
  });
  const { studio } = ENVIRONMENTS;
  studio.harmonics ??= harmonics(studio);
  surface.setSurroundings(studio, studio.harmonics, 1);
  const { direction, light } = studio.key;
  surface.setKey(new THREE.Vector3(...direction).normalize(), new THREE.Vector3().setScalar(light), stage.centre);
  stage.scene.add(scene);
  return scene;
}
