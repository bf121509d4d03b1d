// The avatar: avatar.glb with our materials, posed by 52 weights. What the CPU does for a frame: weights, the eyes'
// rotations, the strain of the details' edges and the gap between the lips.
import { THREE, GLTFLoader } from "./three.js";
import { INDEX, NAMES } from "./shapes.js";

const METRES = 1e-3;
const PIVOT = new THREE.Vector3(0, -0.095, -0.055); // about where a head turns on its neck

export async function loadGlb(address) {
  return new GLTFLoader().loadAsync(address);
}

export class Avatar {
  constructor(gltf, surface, details) {
    this.root = gltf.scene;
    this.details = details;
    this.gap = []; // the vertices whose distance is the gap between the lips
    this.weights = new Float32Array(NAMES.length);
    this.extras = gltf.userData ?? {};
    this.limits = (this.extras.weightLimits ?? []).filter((l) => l.shape in INDEX && l.atMost in INDEX);
    this.meshes = [];
    this.root.traverse((node) => { if (node.isMesh) this.meshes.push(node); });
    this.head = this.meshes.find((mesh) => mesh.name === "head");
    if (!this.head) throw new Error("avatar.glb holds no mesh 'head'");
    this.eyes = ["eye_left", "eye_right"].map((name) => this.root.getObjectByName(name)).filter(Boolean);
    this.surface = surface;
    for (const mesh of this.meshes) {
      mesh.castShadow = mesh.receiveShadow = true;
      mesh.frustumCulled = false; // shapes and the performance move what the bounds were made of
      mesh.material = surface.material(mesh);
    }
    // what is seen of the head without a film: its parts and where they are
    this.rigs = { personalised: new Map(this.meshes.map((mesh) => [mesh.name, mesh.geometry])) };
    this.rig = "personalised";
    this.probe();
    this.wires = null;
    this.setWeights(this.weights);
  }

  get rigNames() {
    return Object.keys(this.rigs);
  }

  // The same meshes of another file with the same triangles: its shapes beside ours.
  addRig(name, gltf) {
    const found = new Map();
    gltf.scene.traverse((node) => { if (node.isMesh) found.set(node.name, node.geometry); });
    for (const mesh of this.meshes) {
      const other = found.get(mesh.name), own = mesh.geometry;
      if (!other || other.attributes.position.count !== own.attributes.position.count)
        throw new Error(`the other shapes do not fit mesh ${mesh.name}`);
      for (const key of ["uv", "tangent", "traits"])
        if (own.attributes[key] && (key === "traits" || !other.attributes[key])) other.setAttribute(key, own.attributes[key]);
    }
    this.rigs[name] = found;
  }

  useRig(name) {
    for (const mesh of this.meshes) mesh.geometry = this.rigs[name].get(mesh.name);
    this.rig = name;
    if (this.wires) this.showWires(true);
    this.probe();
    this.setWeights(this.weights);
  }

  // What the head template tells: gap, two vertices or none; traits (v, 4), see surface.vert.glsl.
  tell(gap, traits) {
    const { count } = this.head.geometry.attributes.position;
    if (traits.length !== 4 * count) throw new Error("traits.bin does not fit avatar.glb");
    const attribute = new THREE.BufferAttribute(traits, 4, true);
    for (const geometries of Object.values(this.rigs)) geometries.get("head").setAttribute("traits", attribute);
    this.gap = gap.every((v) => v < count) ? gap : [];
    this.probe();
    this.setWeights(this.weights);
  }

  // Where the few vertices lie that the CPU has to know of: at rest, and how each shape moves them.
  probe() {
    const edges = this.details?.about.edges ?? [], { gap } = this;
    const vertices = [...new Set([...edges.flat(), ...gap])];
    const geometry = this.head.geometry, rest = geometry.attributes.position;
    const targets = geometry.morphAttributes.position ?? [];
    const rows = new Map(vertices.map((v, i) => [v, i]));
    this.probed = {
      rest: Float32Array.from(vertices.flatMap((v) => [rest.getX(v), rest.getY(v), rest.getZ(v)])),
      deltas: targets.map((t) => Float32Array.from(vertices.flatMap((v) => [t.getX(v), t.getY(v), t.getZ(v)]))),
      edges: edges.map(([a, b]) => [3 * rows.get(a), 3 * rows.get(b)]),
      gap: gap.map((v) => 3 * rows.get(v)),
    };
    this.posed = new Float32Array(this.probed.rest.length);
    const order = this.head.morphTargetDictionary ?? {};
    this.columns = NAMES.map((name) => order[name] ?? -1);
    const own = this.rig === "personalised" ? this.details?.about.rest_mm : null;
    this.rest = own ?? this.lengths(this.probed.rest);
    this.strain = new Float64Array(edges.length);
  }

  lengths(positions) {
    return this.probed.edges.map(([a, b]) =>
      Math.hypot(positions[a] - positions[b], positions[a + 1] - positions[b + 1], positions[a + 2] - positions[b + 2]) / METRES);
  }

  setWeights(weights) {
    this.weights.set(weights);
    const w = Float32Array.from(weights);
    for (const { shape, atMost } of this.limits) w[INDEX[shape]] = Math.min(w[INDEX[shape]], w[INDEX[atMost]]);
    this.allowed = w;
    for (const mesh of this.meshes) {
      const influences = mesh.morphTargetInfluences, order = mesh.morphTargetDictionary;
      if (influences) for (let j = 0; j < NAMES.length; j++) {
        const column = order[NAMES[j]];
        if (column !== undefined) influences[column] = w[j];
      }
    }
    this.turnEyes(w);
    const { rest, deltas, gap } = this.probed;
    this.posed.set(rest);
    for (let j = 0; j < w.length; j++) {
      const delta = this.columns[j] < 0 ? null : deltas[this.columns[j]];
      if (w[j] && delta) for (let i = 0; i < delta.length; i++) this.posed[i] += w[j] * delta[i];
    }
    if (this.details) {
      const lengths = this.lengths(this.posed);
      for (let e = 0; e < lengths.length; e++) this.strain[e] = (lengths[e] - this.rest[e]) / this.rest[e];
      this.details.setStrain(this.strain);
    }
    if (gap.length === 2) {
      const [upper, lower] = gap, p = this.posed;
      const height = Math.max(p[upper + 1] - p[lower + 1], 0);
      this.surface.setMouth((p[upper + 1] + p[lower + 1]) / 2, Math.max(p[upper + 2], p[lower + 2]) - 0.003, height);
    }
  }

  turnEyes(w) {
    const looks = this.extras.eyeLook ?? {};
    for (const eye of this.eyes) {
      const turn = new THREE.Vector3();
      for (const [shape, look] of Object.entries(looks))
        if (look.node === eye.name && shape in INDEX)
          turn.addScaledVector(new THREE.Vector3(...look.axis), w[INDEX[shape]] * THREE.MathUtils.degToRad(look.degrees));
      const angle = turn.length();
      eye.quaternion.setFromAxisAngle(angle > 0 ? turn.divideScalar(angle) : turn.set(1, 0, 0), angle);
    }
  }

  // The head where a film shows it (Matrix4), or turned on its neck (Quaternion), or at rest (null).
  place(where) {
    const head = this.head;
    head.matrixAutoUpdate = true;
    head.position.set(0, 0, 0);
    head.quaternion.identity();
    if (where?.isMatrix4) where.decompose(head.position, head.quaternion, head.scale);
    else if (where?.isQuaternion) {
      head.quaternion.copy(where);
      head.position.copy(PIVOT).sub(PIVOT.clone().applyQuaternion(where));
    }
    head.scale.set(1, 1, 1);
    head.updateMatrixWorld(true);
    this.surface.setHead(head, this.eyes);
  }

  // Another albedo for every part that has the old one.
  setAlbedo(texture, old) {
    for (const { material } of this.meshes)
      if (material.uniforms.map.value === old) material.uniforms.map.value = texture;
  }

  // Lines over the skin, in the same morphed places.
  showWires(on) {
    if (this.wires) {
      for (const wire of this.wires) wire.parent.remove(wire);
      this.wires = null;
    }
    if (!on) return;
    this.wires = this.meshes.map((mesh) => {
      const wire = new THREE.Mesh(mesh.geometry, this.surface.wire);
      wire.morphTargetInfluences = mesh.morphTargetInfluences;
      wire.morphTargetDictionary = mesh.morphTargetDictionary;
      wire.frustumCulled = false;
      wire.renderOrder = 2;
      mesh.add(wire);
      return wire;
    });
  }
}
