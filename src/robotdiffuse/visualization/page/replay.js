"use strict";
// The replay page. It reads everything from the JSON in #data, written by replay_page.py; units m, rad, s; z is up.
const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const dof = data.robot.offsets.length;
const duration = data.times[data.times.length - 1];
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
const color = (rgb) => new THREE.Color().setRGB(rgb[0] / 255, rgb[1] / 255, rgb[2] / 255, THREE.SRGBColorSpace);

// --- Kinematics: T[j + 1] = T[parents[j]] · offset[j] · (turn about, or slide along, z)

const offsets = data.robot.offsets.map((m) => new THREE.Matrix4().set(...m, 0, 0, 0, 1));

function frames(q) {
  const T = [new THREE.Matrix4()];
  for (let j = 0; j < dof; j++) {
    const M = new THREE.Matrix4();
    if (data.robot.prismatic[j]) M.makeTranslation(0, 0, q[j]); else M.makeRotationZ(q[j]);
    T.push(T[data.robot.parents[j]].clone().multiply(offsets[j]).multiply(M));
  }
  return T;
}

function configuration(time) {
  const t = data.times;
  let low = 0, high = t.length - 1;
  if (high === 0 || time <= 0) return data.positions[0];
  if (time >= t[high]) return data.positions[high];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (t[middle] <= time) low = middle; else high = middle;
  }
  const s = (time - t[low]) / (t[high] - t[low]);
  return data.positions[low].map((a, j) => a + s * (data.positions[high][j] - a));
}

// --- The stage

const canvas = $("view");
let renderer;
try {
  renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
} catch (error) {
  $("problem").hidden = false;
  $("problem").textContent = "This replay needs WebGL, which this browser does not support or has disabled.";
  throw error;
}
renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
renderer.shadowMap.enabled = true;
renderer.shadowMap.type = THREE.VSMShadowMap;
renderer.toneMapping = THREE.NeutralToneMapping;
renderer.toneMappingExposure = 0.95;
const scene = new THREE.Scene();
const PAPER = new THREE.Color(0xe9ecf0);
scene.background = PAPER;
const pmrem = new THREE.PMREMGenerator(renderer);
scene.environment = pmrem.fromScene(new THREE.RoomEnvironment(), 0.04).texture;
scene.environmentRotation.x = Math.PI / 2;
scene.environmentIntensity = 0.32;

const camera = new THREE.PerspectiveCamera(data.camera.field, 1, 0.02, 60);
camera.up.set(0, 0, 1);
const controls = new THREE.OrbitControls(camera, canvas);
controls.enableDamping = true;
controls.dampingFactor = 0.12;
controls.minDistance = 0.2;
controls.maxDistance = 12;
controls.maxPolarAngle = Math.PI * 0.53;

const target = new THREE.Vector3(...data.camera.target);
const eye = new THREE.Vector3(...data.camera.eye);
const back = new THREE.Vector3(eye.x - target.x, eye.y - target.y, 0).normalize();
const side = new THREE.Vector3(-back.y, back.x, 0);
const sun = new THREE.DirectionalLight(0xfff8ef, 2.1);
sun.position.copy(target).addScaledVector(back, 1.4).addScaledVector(side, -1.8).add(new THREE.Vector3(0, 0, 3.4));
sun.target.position.copy(target);
sun.castShadow = true;
sun.shadow.mapSize.set(2048, 2048);
Object.assign(sun.shadow.camera, { left: -1.7, right: 1.7, top: 1.7, bottom: -1.7, near: 0.5, far: 9 });
sun.shadow.radius = 11;
sun.shadow.blurSamples = 20;
sun.shadow.bias = -0.0004;
sun.shadow.normalBias = 0.01;
scene.add(sun, sun.target, new THREE.HemisphereLight(0xf3f7ff, 0xd8d6d4, 0.85));

function ground() {
  const material = new THREE.ShaderMaterial({
    transparent: true, depthWrite: false, side: THREE.DoubleSide,
    uniforms: { paper: { value: PAPER } },
    vertexShader: `varying vec2 at; void main() { at = position.xy;
      gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }`,
    fragmentShader: `varying vec2 at;
      float lines(float spacing, float width) { vec2 g = at / spacing, w = fwidth(g);
        vec2 d = abs(fract(g - 0.5) - 0.5) / max(w, vec2(width / spacing));
        vec2 fade = min(vec2(1.0), vec2(width / spacing) / w + 0.35);
        return max((1.0 - smoothstep(0.5, 1.5, d.x)) * fade.x, (1.0 - smoothstep(0.5, 1.5, d.y)) * fade.y); }
      void main() { float far = clamp(1.0 - dot(at, at) / 12.0, 0.0, 1.0);
        float line = max(0.4 * lines(0.25, 0.0025), lines(1.0, 0.0035));
        gl_FragColor = vec4(0.50, 0.55, 0.62, 0.5 * line * far * far); }`,
  });
  const grid = new THREE.Mesh(new THREE.PlaneGeometry(8, 8), material);
  const shadow = new THREE.Mesh(new THREE.PlaneGeometry(12, 12), new THREE.ShadowMaterial({ color: 0x1a2436, opacity: 0.2 }));
  shadow.receiveShadow = true;
  grid.position.z = data.ground - 0.0008;
  shadow.position.z = data.ground - 0.0012;
  grid.renderOrder = -1;
  shadow.renderOrder = -2;
  scene.add(grid, shadow);
}
ground();

// --- The arm

function geometry(part) {
  const g = new THREE.BufferGeometry();
  const raw = new Uint16Array(bytes(part.vertices).buffer);
  const vertices = new Float32Array(raw.length);
  for (let i = 0; i < raw.length; i++) vertices[i] = part.low[i % 3] + raw[i] * part.step;
  g.setAttribute("position", new THREE.BufferAttribute(vertices, 3));
  g.setAttribute("normal", new THREE.BufferAttribute(new Int8Array(bytes(part.normals).buffer), 3, true));
  const faces = bytes(part.faces).buffer;
  g.setIndex(new THREE.BufferAttribute(part.wide ? new Uint32Array(faces) : new Uint16Array(faces), 1));
  if (part.colors) {
    const srgb = bytes(part.colors);
    const linear = new Float32Array(srgb.length);
    for (let i = 0; i < srgb.length; i++) {
      const c = srgb[i] / 255;
      linear[i] = c <= 0.04045 ? c / 12.92 : Math.pow((c + 0.055) / 1.055, 2.4);
    }
    g.setAttribute("color", new THREE.BufferAttribute(linear, 3));
  }
  return g;
}

const links = data.robot.frames.map((part) => (part === null ? null : geometry(part)));

class Arm {
  constructor(materials, from = 0) {
    this.group = new THREE.Group();
    this.parts = [];
    links.forEach((link, frame) => {
      if (link === null || frame < from) return;
      materials.forEach((material, pass) => {
        const mesh = new THREE.Mesh(link, material);
        mesh.matrixAutoUpdate = false;
        mesh.frustumCulled = false;
        mesh.castShadow = mesh.receiveShadow = !material.userData.ghost;
        mesh.renderOrder = material.userData.ghost ? 2 * material.userData.ghost + pass : 0;
        this.group.add(mesh);
        this.parts.push([mesh, frame]);
      });
    });
    scene.add(this.group);
  }
  pose(T) {
    for (const [mesh, frame] of this.parts) { mesh.matrix.copy(T[frame]); mesh.matrixWorldNeedsUpdate = true; }
  }
}

// A see-through arm: first its depth alone, so that only its nearest surface is tinted, denser when seen edge-on.
function ghostMaterials(rgb, order) {
  const depth = new THREE.MeshBasicMaterial({ colorWrite: false, polygonOffset: true, polygonOffsetFactor: 1,
    polygonOffsetUnits: 60, transparent: true });
  const tint = new THREE.ShaderMaterial({
    transparent: true, depthWrite: false, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 50,
    uniforms: { tint: { value: color(rgb) } },
    vertexShader: `varying vec3 n, e; void main() { vec4 p = modelViewMatrix * vec4(position, 1.0);
      n = normalMatrix * normal; e = -p.xyz; gl_Position = projectionMatrix * p; }`,
    fragmentShader: `uniform vec3 tint; varying vec3 n, e; void main() {
      vec3 m = normalize(n); float f = 1.0 - abs(dot(m, normalize(e)));
      gl_FragColor = vec4(tint * (0.8 + 0.35 * m.y), 0.22 + 0.55 * f * f);
      #include <colorspace_fragment>
      }`,
  });
  depth.userData.ghost = tint.userData.ghost = order;
  return [depth, tint];
}

const arm = new Arm([new THREE.MeshPhysicalMaterial({ vertexColors: true, color: 0xf2f2f2, roughness: 0.42,
  clearcoat: 0.35, clearcoatRoughness: 0.3 })]);
const startArm = new Arm(ghostMaterials(data.start_color, 5), 1);
const goalArm = new Arm(ghostMaterials(data.goal_color, 6), 1);
startArm.pose(frames(data.positions[0]));
goalArm.pose(frames(data.positions[data.positions.length - 1]));

const spheres = new THREE.Group();
const ball = new THREE.SphereGeometry(1, 24, 16);
const sphereMaterial = new THREE.MeshStandardMaterial({ color: 0x7a5fd0, transparent: true, opacity: 0.32,
  depthWrite: false, roughness: 0.6 });
for (const [frame, x, y, z, radius] of data.robot.spheres) {
  const holder = new THREE.Group();
  const mesh = new THREE.Mesh(ball, sphereMaterial);
  mesh.position.set(x, y, z);
  mesh.scale.setScalar(radius);
  holder.add(mesh);
  holder.matrixAutoUpdate = false;
  holder.userData.frame = frame;
  spheres.add(holder);
}
spheres.visible = false;
scene.add(spheres);

// --- Obstacles

function cloud(shape) {
  const raw = new Uint16Array(bytes(shape.points).buffer);
  const points = new Float32Array(raw.length);
  for (let i = 0; i < raw.length; i++) points[i] = shape.low[i % 3] + raw[i] * shape.step;
  const g = new THREE.BufferGeometry();
  g.setAttribute("position", new THREE.BufferAttribute(points, 3));
  // Each point is a disc that is shaded as the ball it stands for.
  const material = new THREE.ShaderMaterial({
    uniforms: { radius: { value: shape.radius }, scale: { value: 1 }, tint: { value: color(shape.color) } },
    vertexShader: `uniform float radius, scale; varying float up; void main() {
      vec4 p = modelViewMatrix * vec4(position, 1.0); gl_Position = projectionMatrix * p; up = position.z;
      gl_PointSize = max(1.5, 2.0 * radius * scale / -p.z); }`,
    fragmentShader: `uniform vec3 tint; varying float up; void main() { vec2 c = 2.0 * gl_PointCoord - 1.0;
      float s = dot(c, c); if (s > 1.0) discard; vec3 n = vec3(c.x, -c.y, sqrt(1.0 - s));
      float lit = 0.62 + 0.42 * max(0.0, dot(n, normalize(vec3(-0.4, 0.8, 0.6))));
      gl_FragColor = vec4(tint * lit * (0.9 + 0.12 * clamp(up, 0.0, 1.0)), 1.0);
      #include <colorspace_fragment>
      }`,
  });
  const object = new THREE.Points(g, material);
  object.onBeforeRender = () => {
    material.uniforms.scale.value = renderer.getDrawingBufferSize(new THREE.Vector2()).y
      / (2 * Math.tan((camera.fov * Math.PI) / 360));
  };
  return object;
}

const upright = (g) => g.rotateX(Math.PI / 2); // three.js builds its round solids about y
const SOLIDS = {
  sphere: (s) => new THREE.SphereGeometry(s.radius, 64, 40),
  box: (s) => new THREE.BoxGeometry(...s.size),
  cylinder: (s) => upright(new THREE.CylinderGeometry(s.radius, s.radius, s.height, 72)),
  capsule: (s) => upright(new THREE.CapsuleGeometry(s.radius, s.height, 20, 56)),
  mesh: (s) => geometry(s.surface),
};
function obstacle(shape) {
  if (shape.kind === "point_cloud") return cloud(shape);
  const mesh = new THREE.Mesh(SOLIDS[shape.kind](shape), new THREE.MeshStandardMaterial({
    color: color(shape.color), roughness: 0.62, side: shape.kind === "mesh" ? THREE.DoubleSide : THREE.FrontSide }));
  if (shape.center) mesh.position.set(...shape.center);
  if (shape.wxyz) mesh.quaternion.set(shape.wxyz[1], shape.wxyz[2], shape.wxyz[3], shape.wxyz[0]);
  mesh.castShadow = mesh.receiveShadow = true;
  return mesh;
}
const obstacles = new THREE.Group();
for (const shape of data.scene) obstacles.add(obstacle(shape));
const movers = data.moving.map(({ shape, track }) => {
  const group = new THREE.Group();
  group.add(obstacle(shape));
  obstacles.add(group);
  return { group, track };
});
function moveObstacles(share) {
  for (const { group, track } of movers) {
    const at = share * (track.length - 1), row = Math.min(Math.floor(at), Math.max(0, track.length - 2));
    const a = track[row], b = track[Math.min(row + 1, track.length - 1)];
    const turn = (p) => group.quaternion.clone().set(p[4], p[5], p[6], p[3]); // three.min.js exports no Quaternion
    group.position.set(...a).lerp(new THREE.Vector3(...b), at - row);
    group.quaternion.copy(turn(a)).slerp(turn(b), at - row);
  }
}
scene.add(obstacles);

// --- Traces

function trace(points, radius, paint) {
  const sides = 8, n = points.length;
  const p = points.map((v) => new THREE.Vector3(...v));
  const position = [], normal = [], colors = [], index = [];
  let across = new THREE.Vector3(0.3, 0.5, 0.8);
  for (let i = 0; i < n; i++) {
    const along = p[Math.min(i + 1, n - 1)].clone().sub(p[Math.max(i - 1, 0)]).normalize();
    across.addScaledVector(along, -across.dot(along)).normalize();
    const other = along.clone().cross(across);
    const c = paint(i / Math.max(1, n - 1));
    for (let k = 0; k < sides; k++) {
      const a = (2 * Math.PI * k) / sides;
      const out = across.clone().multiplyScalar(Math.cos(a)).addScaledVector(other, Math.sin(a));
      normal.push(out.x, out.y, out.z);
      position.push(p[i].x + radius * out.x, p[i].y + radius * out.y, p[i].z + radius * out.z);
      colors.push(c.r, c.g, c.b);
      if (i + 1 < n) {
        const a0 = i * sides + k, b0 = i * sides + ((k + 1) % sides);
        index.push(a0, b0, a0 + sides, b0, b0 + sides, a0 + sides);
      }
    }
  }
  const g = new THREE.BufferGeometry();
  g.setAttribute("position", new THREE.BufferAttribute(new Float32Array(position), 3));
  g.setAttribute("normal", new THREE.BufferAttribute(new Float32Array(normal), 3));
  g.setAttribute("color", new THREE.BufferAttribute(new Float32Array(colors), 3));
  g.setIndex(index);
  const material = new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.5, side: THREE.DoubleSide });
  return new THREE.Mesh(g, material);
}

const tool = new THREE.Vector3(...data.robot.tool.point);
const toolAt = (q) => tool.clone().applyMatrix4(frames(q)[data.robot.tool.frame]);
const startColor = color(data.start_color), goalColor = color(data.goal_color);
const traces = new THREE.Group();
{
  const steps = duration > 0 ? Math.min(400, Math.max(60, 4 * data.times.length)) : 0;
  const points = [];
  for (let i = 0; i <= steps; i++) points.push(toolAt(configuration((duration * i) / Math.max(1, steps))).toArray());
  if (steps > 0) traces.add(trace(points, 0.005, (s) => startColor.clone().lerp(goalColor, s)));
  const last = toolAt(data.positions[data.positions.length - 1]).toArray();
  for (const [at, c] of [[points[0], startColor], [last, goalColor]]) {
    const dot = new THREE.Mesh(ball, new THREE.MeshStandardMaterial({ color: c, roughness: 0.5 }));
    dot.scale.setScalar(0.012);
    dot.position.set(...at);
    traces.add(dot);
  }
}
scene.add(traces);

// --- Panels

for (const [label, value] of data.facts) {
  const dt = document.createElement("dt"), dd = document.createElement("dd");
  dt.textContent = label;
  dd.textContent = value;
  if (label === "status") dd.className = value === "solved" ? "good" : "bad";
  $("facts").append(dt, dd);
}
function toggle(name, objects) {
  const button = document.createElement("button");
  button.textContent = name;
  const show = (on) => { objects.forEach((o) => { o.visible = on; }); button.setAttribute("aria-pressed", on); dirty = true; };
  button.onclick = () => show(!objects[0].visible);
  show(objects[0].visible);
  $("toggles").append(button);
}
let dirty = true;
toggle("Start", [startArm.group]);
toggle("Goal", [goalArm.group]);
toggle("Trace", [traces]);
if (data.robot.spheres.length) toggle("Spheres", [spheres]);
if (obstacles.children.length) toggle("Obstacles", [obstacles]);
{
  const button = document.createElement("button");
  button.textContent = "Reset view";
  button.onclick = () => { controls.target.copy(target); camera.position.copy(home()); dirty = true; };
  $("toggles").append(button);
}

const HUES = ["#d9614c", "#e0963f", "#a6a234", "#3fa66b", "#2f9fb5", "#4f7fd9", "#9566c9", "#c95f9b"];
const hue = (j) => HUES[j % HUES.length];
const values = data.robot.joints.map((name, j) => {
  const span = document.createElement("span"), mark = document.createElement("i"), value = document.createElement("b");
  mark.style.background = hue(j);
  span.title = name;
  span.append(mark, `${j + 1} `, value);
  $("legend").append(span);
  return value;
});

const plot = $("plot");
const PAD = { left: 30, right: 6, top: 6, bottom: 16 };
let plotted = null; // the curves, drawn once for each size
let range = [0, 1];
{
  const all = data.positions.flat();
  const low = Math.min(...data.positions.map((q) => Math.min(...q))), high = Math.max(...data.positions.map((q) => Math.max(...q)));
  const room = 0.06 * Math.max(high - low, 0.1) + (all.length ? 0 : 1);
  range = [low - room, high + room];
}
function niceStep(span, count) {
  const raw = span / count, ten = Math.pow(10, Math.floor(Math.log10(raw)));
  return ten * [1, 2, 5, 10].find((m) => m * ten >= raw);
}
function drawPlot(time) {
  const ratio = window.devicePixelRatio || 1, w = plot.clientWidth, h = plot.clientHeight;
  if (!w) return;
  const pen = plot.getContext("2d");
  const X = (t) => PAD.left + (w - PAD.left - PAD.right) * (duration > 0 ? t / duration : 0);
  const Y = (v) => h - PAD.bottom - ((h - PAD.bottom - PAD.top) * (v - range[0])) / (range[1] - range[0]);
  if (!plotted || plotted.w !== w || plotted.h !== h || plotted.ratio !== ratio) {
    plot.width = w * ratio; plot.height = h * ratio;
    const sheet = document.createElement("canvas");
    sheet.width = plot.width; sheet.height = plot.height;
    const p = sheet.getContext("2d");
    p.scale(ratio, ratio);
    p.font = "10px system-ui, sans-serif";
    p.fillStyle = "#8a93a0"; p.strokeStyle = "rgba(34,43,56,.1)"; p.lineWidth = 1;
    p.textAlign = "right"; p.textBaseline = "middle";
    const step = niceStep(range[1] - range[0], 4);
    for (let v = Math.ceil(range[0] / step) * step; v <= range[1]; v += step) {
      p.beginPath(); p.moveTo(PAD.left, Y(v)); p.lineTo(w - PAD.right, Y(v)); p.stroke();
      p.fillText(String(+v.toFixed(2)), PAD.left - 5, Y(v));
    }
    p.textBaseline = "bottom"; p.textAlign = "center";
    const tick = duration > 0 ? niceStep(duration, 5) : 1;
    for (let t = 0; t <= duration; t += tick) if (X(t) < w - 22) p.fillText(String(+t.toFixed(3)), X(t), h);
    p.textAlign = "right"; p.fillText(data.timed ? "s" : "", w - PAD.right, h);
    p.lineWidth = 1.5; p.lineJoin = "round";
    for (let j = 0; j < dof; j++) {
      p.strokeStyle = hue(j); p.beginPath();
      data.times.forEach((t, i) => p.lineTo(X(t), Y(data.positions[i][j])));
      p.stroke();
    }
    plotted = { sheet, w, h, ratio };
  }
  pen.setTransform(1, 0, 0, 1, 0, 0);
  pen.clearRect(0, 0, plot.width, plot.height);
  pen.drawImage(plotted.sheet, 0, 0);
  pen.scale(ratio, ratio);
  pen.strokeStyle = "rgba(34,43,56,.55)"; pen.lineWidth = 1;
  pen.beginPath(); pen.moveTo(X(time), PAD.top); pen.lineTo(X(time), h - PAD.bottom); pen.stroke();
  configuration(time).forEach((v, j) => {
    pen.fillStyle = hue(j); pen.beginPath(); pen.arc(X(time), Y(v), 2.6, 0, 2 * Math.PI); pen.fill();
  });
}

// --- Time

const followers = []; // called with the time whenever it changes
let time = 0, playing = false, rest = 0, last = null; // rest: time spent at the end [s]
const END_PAUSE = 0.9; // pause at the end of the motion before it repeats [s]
const ICONS = { play: "M8 5.2v13.6L19 12z", pause: "M7 5h3.6v14H7zm6.4 0H17v14h-3.6z" };

function setPlaying(on) {
  playing = on && duration > 0;
  $("icon").setAttribute("d", playing ? ICONS.pause : ICONS.play);
  if (playing && time >= duration) time = 0;
  rest = 0; last = null; dirty = true;
}
function setTime(t) {
  time = Math.min(duration, Math.max(0, t));
  const q = configuration(time), T = frames(q);
  arm.pose(T);
  for (const holder of spheres.children) {
    holder.matrix.copy(T[holder.userData.frame]);
    holder.matrixWorldNeedsUpdate = true;
  }
  const share = duration > 0 ? time / duration : 0;
  moveObstacles(share);
  $("slider").value = share;
  $("slider").style.setProperty("--at", `${100 * share}%`);
  $("clock").innerHTML = data.timed ? `<b>${time.toFixed(2)}</b> / ${duration.toFixed(2)} s`
    : `<b>${(100 * share).toFixed(0)}</b> %`;
  q.forEach((v, j) => { values[j].textContent = v.toFixed(2); });
  drawPlot(time);
  for (const follow of followers) follow(time);
  dirty = true;
}
const scrub = (share) => { setPlaying(false); setTime(share * duration); };
$("play").onclick = () => setPlaying(!playing);
$("slider").oninput = (event) => scrub(Number(event.target.value));
const seek = (event) => {
  const box = plot.getBoundingClientRect();
  scrub((event.clientX - box.left - PAD.left) / (box.width - PAD.left - PAD.right));
};
plot.onpointerdown = (event) => { plot.setPointerCapture(event.pointerId); seek(event); };
plot.onpointermove = (event) => { if (event.buttons) seek(event); };
window.addEventListener("keydown", (event) => {
  if (event.target.tagName === "SELECT") return;
  if (event.code === "Space") { event.preventDefault(); event.target.blur?.(); setPlaying(!playing); }
  if (event.code === "ArrowLeft") { event.preventDefault(); scrub((time - duration / 100) / (duration || 1)); }
  if (event.code === "ArrowRight") { event.preventDefault(); scrub((time + duration / 100) / (duration || 1)); }
});

// --- Camera and loop

// The camera was chosen for one shape of window; a narrower one needs more distance.
function home() {
  const wider = Math.max(1, data.camera.aspect / camera.aspect);
  return target.clone().addScaledVector(eye.clone().sub(target), wider);
}
function resize() {
  const w = window.innerWidth, h = window.innerHeight;
  const first = camera.aspect === 1;
  renderer.setSize(w, h, false);
  camera.aspect = w / h;
  camera.updateProjectionMatrix();
  if (first) { controls.target.copy(target); camera.position.copy(home()); }
  drawPlot(time);
  dirty = true;
}
window.addEventListener("resize", resize);
controls.addEventListener("change", () => { dirty = true; });
resize();
setTime(Math.min(1, Math.max(0, Number(/[#&]at=([\d.]+)/.exec(location.hash)?.[1] ?? 0))) * duration);

function tick(now) {
  requestAnimationFrame(tick);
  const dt = last === null ? 0 : Math.min(0.1, (now - last) / 1000);
  last = now;
  if (playing) {
    if (time >= duration) {
      rest += dt;
      if (rest > END_PAUSE) { rest = 0; setTime(0); }
    } else {
      setTime(time + dt * Number($("speed").value));
    }
  }
  controls.update();
  if (dirty) { renderer.render(scene, camera); dirty = false; }
}
requestAnimationFrame(tick);
setPlaying(!location.hash.includes("at="));
if (duration === 0) document.querySelector("footer").style.display = "none"; // nothing moves
