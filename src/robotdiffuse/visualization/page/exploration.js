// --- An exploration: what was known over time. This runs after replay.js; exploration.py writes data.exploration.

const recording = data.exploration;
const [NX, NY, NZ] = recording.shape;

// Face indices, stored as differences from one to the next in groups of 7 bits, the lowest first.
function numbers(text) {
  const out = [];
  let last = 0, value = 0, shift = 0;
  for (const byte of bytes(text)) {
    value += (byte & 127) * 2 ** shift;
    shift += 7;
    if (byte < 128) { last += value; out.push(last); value = 0; shift = 0; }
  }
  return out;
}

// The numbers that are in exactly one of two ascending lists.
function toggled(a, b) {
  const out = [];
  let i = 0, j = 0;
  while (i < a.length || j < b.length) {
    if (j >= b.length || a[i] < b[j]) out.push(a[i++]);
    else if (i >= a.length || b[j] < a[i]) out.push(b[j++]);
    else { i++; j++; }
  }
  return out;
}

const UNITS = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];

function quads(faces) {
  const position = new Float32Array(12 * faces.length), normal = new Int8Array(12 * faces.length);
  const index = new Uint32Array(6 * faces.length);
  faces.forEach((face, n) => {
    const axis = Math.floor(face / (NX * NY * NZ)), flat = face % (NX * NY * NZ);
    const at = [Math.floor(flat / (NY * NZ)), Math.floor(flat / NZ) % NY, flat % NZ];
    const along = UNITS[axis], across = UNITS[(axis + 1) % 3], up = UNITS[(axis + 2) % 3];
    [[0, 0], [1, 0], [1, 1], [0, 1]].forEach(([s, t], k) => {
      for (let c = 0; c < 3; c++) {
        position[12 * n + 3 * k + c] = recording.low[c] + recording.edge * (at[c] + along[c] + s * across[c] + t * up[c]);
        normal[12 * n + 3 * k + c] = 127 * along[c];
      }
    });
    index.set([0, 1, 2, 0, 2, 3].map((k) => 4 * n + k), 6 * n);
  });
  const g = new THREE.BufferGeometry();
  g.setAttribute("position", new THREE.BufferAttribute(position, 3));
  g.setAttribute("normal", new THREE.BufferAttribute(normal, 3, true));
  g.setIndex(new THREE.BufferAttribute(index, 1));
  return g;
}

// A see-through layer writes its depth first, so that only its nearest faces are tinted.
const layers = recording.layers.map((layer) => {
  const clear = layer.opacity < 1, group = new THREE.Group();
  const solid = new THREE.MeshStandardMaterial({ color: color(layer.color), roughness: 0.8, side: THREE.DoubleSide,
    transparent: clear, opacity: layer.opacity, depthWrite: !clear });
  const depth = new THREE.MeshBasicMaterial({ colorWrite: false, side: THREE.DoubleSide, transparent: true,
    polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 4 });
  const meshes = (clear ? [depth, solid] : [solid]).map((material, pass) => {
    const mesh = new THREE.Mesh(new THREE.BufferGeometry(), material);
    mesh.frustumCulled = false;
    mesh.renderOrder = clear ? layer.order + pass : 0;
    mesh.castShadow = mesh.receiveShadow = !clear;
    group.add(mesh);
    return mesh;
  });
  scene.add(group);
  return { group, meshes, states: [] };
});
layers.forEach((layer, l) => {
  let faces = [];
  for (const known of recording.known) {
    faces = toggled(faces, numbers(known.layers[l]));
    layer.states.push(faces);
  }
});

const LOOK = color(recording.look_color);
const looks = recording.steps.map((step) => {
  const group = new THREE.Group();
  for (const edge of step.look) group.add(trace(edge, 0.004, () => LOOK));
  group.visible = false;
  scene.add(group);
  return group;
});
const lookArm = new Arm(ghostMaterials(recording.look_color, 7), 1);
lookArm.group.visible = false;

const trueScene = new THREE.Group();
for (const shape of recording.true_scene) {
  const object = obstacle(shape);
  object.castShadow = object.receiveShadow = false;
  if (shape.kind !== "point_cloud") Object.assign(object.material, { transparent: true, opacity: 0.3, depthWrite: false });
  trueScene.add(object);
}
trueScene.visible = false;
scene.add(trueScene);

const steps = document.createElement("ol");
steps.id = "steps";
steps.className = "panel";
const rows = recording.steps.map((step, i) => {
  const row = document.createElement("li"), title = document.createElement("b"), details = document.createElement("span");
  title.textContent = step.title;
  details.textContent = `${step.reason} (${step.known})`;
  row.append(title, details);
  row.onclick = () => scrub(step.time / (duration || 1));
  steps.append(row);
  return row;
});
document.body.append(steps);

startArm.group.visible = false;
$("toggles").firstChild.setAttribute("aria-pressed", false);

// The toggles of the layers, marked with their colors, come before the others.
const first = $("toggles").firstChild;
const addToggle = (name, objects, rgb) => {
  toggle(name, objects);
  const button = $("toggles").lastChild;
  if (rgb) {
    const mark = document.createElement("i");
    mark.style.background = `rgb(${rgb})`;
    button.prepend(mark);
  }
  $("toggles").insertBefore(button, first);
};
recording.layers.forEach((layer, l) => addToggle(layer.name, [layers[l].group], layer.color));
addToggle("Next view", [new THREE.Group()], recording.look_color);
const lookToggle = $("toggles").children[recording.layers.length];
addToggle("True scene", [trueScene]);

const latest = (list, at) => Math.max(0, list.findLastIndex((entry) => entry.time <= at + 1e-6));
let shownKnown = -1;
function follow(at) {
  const k = latest(recording.known, at), a = latest(recording.steps, at);
  if (k !== shownKnown) {
    layers.forEach((layer) => {
      layer.meshes[0].geometry.dispose();
      const g = quads(layer.states[k]);
      for (const mesh of layer.meshes) mesh.geometry = g;
    });
    shownKnown = k;
  }
  const on = lookToggle.getAttribute("aria-pressed") === "true";
  looks.forEach((look, i) => { look.visible = on && i === a; });
  lookArm.group.visible = on && recording.steps[a].end !== null;
  if (recording.steps[a].end !== null) lookArm.pose(frames(recording.steps[a].end));
  rows.forEach((row, i) => row.setAttribute("aria-current", i === a));
  dirty = true;
}
lookToggle.addEventListener("click", () => follow(time));
followers.push(follow);
follow(time);
