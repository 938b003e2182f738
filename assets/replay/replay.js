// The replay of a rollout in 3-D: reads the block that sim2grid/show/replay.py packs and draws it
// with three.js. x east, y north, z up, metres, mission seconds.
import * as THREE from 'three';
import { OrbitControls } from 'three/addons/controls/OrbitControls.js';

const root = document.getElementById('replay');
const part = name => root.querySelector(name);
const TYPES = { u1: Uint8Array, u2: Uint16Array, f4: Float32Array };
const SPEED_WINDOW = 0.6;  // s, as in the film
const AT_REST = 0.12;  // m/s, as in the film
const LABEL = 21;  // pixels, with the room about the letters
const PACES = [1, 2, 3, 5, 8, 10, 15, 20];

async function unpack(text) {
  const bytes = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
  const buffer = await new Response(stream).arrayBuffer();
  const length = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  head.array = ([kind, at, size]) => new TYPES[kind](buffer, 4 + length + at, size);
  return head;
}

function dequantised(head, packed) {
  const numbers = head.array(packed.data), width = packed.low.length;
  return Float32Array.from(numbers, (n, k) => packed.low[k % width] + packed.step[k % width] * n);
}

// Poses: numbers over time, each kept as the difference from the one before.
class Poses {
  constructor(head) {
    const packed = head.poses;
    this.times = head.array(packed.times);
    this.count = this.times.length;
    const differences = head.array(packed.data);
    this.numbers = packed.low.map((low, c) => {
      const row = new Float32Array(this.count);
      let sum = 0;
      for (let k = 0; k < this.count; k++) {
        sum = (sum + differences[c * this.count + k]) & 0xffff;
        row[k] = low + packed.step[c] * sum;
      }
      return row;
    });
  }
  // The row at or before a second, and how far it is to the next.
  place(time) {
    let low = 0, high = this.count - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (this.times[middle] <= time) low = middle; else high = middle;
    }
    const span = this.times[high] - this.times[low];
    return [low, high, span > 0 ? Math.min(1, Math.max(0, (time - this.times[low]) / span)) : 0];
  }
  at(channel, place) {
    const row = this.numbers[channel];
    return row[place[0]] + place[2] * (row[place[1]] - row[place[0]]);
  }
}

class Ground {
  constructor(head) {
    const its = head.ground;
    [this.rows, this.columns] = its.shape;
    [this.west, this.south] = its.corner;
    this.spacing = its.spacing;
    this.heights = dequantised(head, its.heights);
    this.shut = head.array(its.shut);
  }
  height(x, y) {
    const u = Math.min(Math.max((x - this.west) / this.spacing, 0), this.columns - 1.001);
    const v = Math.min(Math.max((y - this.south) / this.spacing, 0), this.rows - 1.001);
    const i = Math.floor(u), j = Math.floor(v), fx = u - i, fy = v - j, h = this.heights;
    const at = j * this.columns + i, sw = h[at], se = h[at + 1];
    const nw = h[at + this.columns], ne = h[at + this.columns + 1];
    return sw + fx * (fx >= fy ? se - sw : ne - nw) + fy * (fx >= fy ? ne - se : nw - sw);
  }
  mesh() {
    const places = new Float32Array(3 * this.heights.length);
    const colours = new Float32Array(3 * this.heights.length), corners = [];
    const uv = new Float32Array(2 * this.heights.length);
    for (let j = 0; j < this.rows; j++) for (let i = 0; i < this.columns; i++) {
      const k = j * this.columns + i, x = this.west + i * this.spacing;
      const y = this.south + j * this.spacing;
      places.set([x, y, this.heights[k]], 3 * k);
      colours.set(this.shut[k] ? [0.75, 0.42, 0.40] : [0.62, 0.61, 0.59], 3 * k);
      uv.set([x / 5, y / 5], 2 * k);
      if (i + 1 < this.columns && j + 1 < this.rows) {  // split as the physics splits it
        const n = k + this.columns;
        corners.push(k, k + 1, n + 1, k, n + 1, n);
      }
    }
    const shape = new THREE.BufferGeometry();
    shape.setAttribute('position', new THREE.BufferAttribute(places, 3));
    shape.setAttribute('color', new THREE.BufferAttribute(colours, 3));
    shape.setAttribute('uv', new THREE.BufferAttribute(uv, 2));
    shape.setIndex(corners);
    shape.computeVertexNormals();
    const found = new THREE.Mesh(shape, new THREE.MeshLambertMaterial(
      { vertexColors: true, map: grain() }));
    found.receiveShadow = found.castShadow = true;
    return found;
  }
}

function grain() {
  const side = 256, canvas = document.createElement('canvas');
  canvas.width = canvas.height = side;
  const pen = canvas.getContext('2d'), image = pen.createImageData(side, side);
  let seed = 7;
  const random = () => (seed = (seed * 16807) % 2147483647) / 2147483647;
  for (let k = 0; k < side * side; k++) {
    const shade = 205 + 50 * random();
    image.data.set([shade, shade, shade, 255], 4 * k);
  }
  pen.putImageData(image, 0, 0);
  const found = new THREE.CanvasTexture(canvas);
  found.wrapS = found.wrapT = THREE.RepeatWrapping;
  found.colorSpace = THREE.SRGBColorSpace;
  return found;
}

function polyhedron(head, packed) {
  const shape = new THREE.BufferGeometry();
  shape.setAttribute('position', new THREE.BufferAttribute(dequantised(head, packed.vertices), 3));
  shape.setIndex(Array.from(head.array(packed.faces)));
  const flat = shape.toNonIndexed();
  flat.computeVertexNormals();
  return flat;
}

const quaternion = ([w, x, y, z]) => new THREE.Quaternion(x, y, z, w).normalize();

// Robots: MuJoCo's tree of bodies, each joint a turn or a shift about its own place.
class Robots {
  constructor(head, scene) {
    this.head = head;
    this.list = head.robots.map(spec => ({ ...spec, root: null }));
    this.joints = [];
    const ends = new Map();
    for (const [id, body] of Object.entries(head.bodies)) {
      const frame = new THREE.Group();
      frame.position.fromArray(body.pos);
      frame.quaternion.copy(quaternion(body.quat));
      (ends.get(body.parent) ?? scene).add(frame);
      let end = frame;
      for (const joint of body.joints) {
        const moved = joint.type === 'free' ? frame : new THREE.Group();
        if (moved !== frame) { end.add(moved); end = moved; }
        this.joints.push({ ...joint, moved, axis: new THREE.Vector3(...joint.axis),
                           anchor: new THREE.Vector3(...joint.pos) });
      }
      ends.set(Number(id), end);
      const robot = this.list[body.robot];
      robot.root ??= frame;
      robot.main ??= Number(id);
    }
    this.shapes = {};
    for (const geom of head.geoms) this.add(geom, ends);
  }
  add(geom, ends) {
    const robot = this.list[this.head.bodies[geom.body].robot];
    const colour = new THREE.Color().setRGB(...geom.rgba.slice(0, 3), THREE.SRGBColorSpace);
    if (geom.body === robot.main && Math.max(...geom.rgba.slice(0, 3)) > 0.5) {
      colour.lerp(new THREE.Color(robot.colour), 0.45);
    }
    const material = new THREE.MeshStandardMaterial({
      color: colour, roughness: 0.6, metalness: 0.15, transparent: geom.rgba[3] < 1,
      opacity: geom.rgba[3] });
    const mesh = new THREE.Mesh(this.shape(geom), material);
    mesh.position.fromArray(geom.pos);
    mesh.quaternion.copy(quaternion(geom.quat));
    if (geom.type === 'ellipsoid') mesh.scale.fromArray(geom.size);
    mesh.castShadow = mesh.receiveShadow = true;
    ends.get(geom.body).add(mesh);
  }
  shape({ type, size, mesh }) {
    if (type === 'mesh') {
      return this.shapes[mesh] ??= polyhedron(this.head, this.head.meshes[mesh]);
    }
    if (type === 'sphere') return new THREE.SphereGeometry(size[0], 16, 12);
    if (type === 'ellipsoid') return new THREE.SphereGeometry(1, 20, 14);
    if (type === 'box') return new THREE.BoxGeometry(...size.map(half => 2 * half));
    const along = type === 'capsule' ? new THREE.CapsuleGeometry(size[0], 2 * size[1], 6, 12)
      : new THREE.CylinderGeometry(size[0], size[0], 2 * size[1], 24);
    return along.rotateX(Math.PI / 2);  // MuJoCo's stand along z
  }
  pose(poses, place) {
    for (const { type, at, zero, moved, axis, anchor } of this.joints) {
      const value = poses.at(at, place);
      if (type === 'slide') {
        moved.position.copy(axis).multiplyScalar(value - zero);
      } else if (type === 'hinge') {
        moved.quaternion.setFromAxisAngle(axis, value - zero);
        moved.position.copy(anchor).sub(anchor.clone().applyQuaternion(moved.quaternion));
      } else {
        const first = type === 'free' ? at + 3 : at;
        const part = k => poses.at(first + k, place);
        moved.quaternion.set(part(1), part(2), part(3), part(0)).normalize();
        if (type === 'free') {
          moved.position.set(value, poses.at(at + 1, place), poses.at(at + 2, place));
        } else {
          moved.position.copy(anchor).sub(anchor.clone().applyQuaternion(moved.quaternion));
        }
      }
    }
  }
}

// A flat ribbon through points [x, y, z]; drawn up to a number of its pieces.
function ribbon(points, width, colour, opacity, dashed = 0) {
  const places = [], corners = [];
  for (let k = 0; k + 1 < points.length; k++) {
    const [a, b] = [points[k], points[k + 1]];
    const length = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1;
    const [dx, dy] = [-(b[1] - a[1]) / length * width / 2, (b[0] - a[0]) / length * width / 2];
    const n = places.length / 3;
    for (const [p, s] of [[a, 1], [a, -1], [b, 1], [b, -1]]) {
      places.push(p[0] + s * dx, p[1] + s * dy, p[2]);
    }
    if (!dashed || k % (2 * dashed) < dashed) corners.push(n, n + 1, n + 3, n, n + 3, n + 2);
  }
  const shape = new THREE.BufferGeometry();
  shape.setAttribute('position', new THREE.Float32BufferAttribute(places, 3));
  shape.setIndex(corners);
  const found = new THREE.Mesh(shape, new THREE.MeshBasicMaterial({
    color: colour, side: THREE.DoubleSide, transparent: opacity < 1, opacity }));
  found.frustumCulled = false;
  return found;
}

function line(ground, from, to, lift) {
  const length = Math.hypot(to[0] - from[0], to[1] - from[1]);
  const count = Math.max(1, Math.ceil(length / 0.15));
  return Array.from({ length: count + 1 }, (_, k) => {
    const x = from[0] + (to[0] - from[0]) * k / count, y = from[1] + (to[1] - from[1]) * k / count;
    return [x, y, ground.height(x, y) + lift];
  });
}

// Words that stand upright; `resize` says how large.
function label(text, colour) {
  const canvas = document.createElement('canvas'), pen = canvas.getContext('2d');
  const font = 'bold 44px system-ui, "DejaVu Sans", sans-serif';
  pen.font = font;
  canvas.width = Math.ceil(pen.measureText(text).width) + 24;
  canvas.height = 64;
  pen.font = font;
  pen.textBaseline = 'middle';
  pen.lineJoin = 'round';
  pen.lineWidth = 9;
  pen.strokeStyle = '#0e111a';
  pen.strokeText(text, 12, 33);
  pen.fillStyle = colour;
  pen.fillText(text, 12, 33);
  const texture = new THREE.CanvasTexture(canvas);
  texture.colorSpace = THREE.SRGBColorSpace;
  const found = new THREE.Sprite(new THREE.SpriteMaterial({
    map: texture, sizeAttenuation: false, depthTest: false, transparent: true }));
  found.userData.ratio = canvas.width / canvas.height;
  found.center.set(0.5, 0);
  found.renderOrder = 2;
  return found;
}

class Target {
  constructor(spec, head, ground, scene) {
    this.spec = spec;
    this.colours = head.colours;
    const r = 0.46 * head.cell, [x, y] = spec.at;
    const corners = [[x - r, y - r], [x + r, y - r], [x + r, y + r], [x - r, y + r], [x - r, y - r]];
    const points = corners.slice(1).flatMap((to, k) => line(ground, corners[k], to, 0.04));
    const tall = 1.1, foot = ground.height(x, y);
    this.group = new THREE.Group();
    this.outline = ribbon(points, 0.06 * head.cell, '#ffffff', 1);
    this.post = new THREE.Mesh(new THREE.CylinderGeometry(0.025, 0.025, tall).rotateX(Math.PI / 2),
                               new THREE.MeshBasicMaterial());
    this.post.position.set(x, y, foot + tall / 2);
    this.labels = {};
    for (const state of ['open', 'serving', 'solved', 'lapsed', 'closed']) {
      const sign = label(`${spec.name} ${spec.needs}`, this.colour(state));
      sign.position.set(x, y, foot + tall + 0.05);
      this.labels[state] = sign;
      this.group.add(sign);
    }
    this.group.add(this.outline, this.post);
    scene.add(this.group);
  }
  colour(state) {
    return { closed: '#8a93a6', lapsed: '#8a93a6' }[state] ?? this.colours[state];
  }
  state(time) {
    const its = this.spec;
    if (its.solved !== null && time >= its.solved - 1e-6) return 'solved';
    if (time < its.known - 1e-6) return 'unknown';
    if (its.lapses !== null && time > its.lapses && its.solved === null) return 'lapsed';
    if (its.solved !== null && time >= its.solved - its.service) return 'serving';
    return time < its.appears ? 'closed' : 'open';
  }
  show(time) {
    const state = this.state(time);
    this.group.visible = state !== 'unknown';
    for (const [name, sign] of Object.entries(this.labels)) sign.visible = name === state;
    for (const mesh of [this.outline, this.post]) mesh.material.color.set(this.colour(state));
  }
}

class Replay {
  constructor(head) {
    this.head = head;
    this.duration = head.seconds;
    this.now = 0;
    this.pace = 5;
    this.playing = false;
    this.chosen = this.asked = null;
    this.ground = new Ground(head);
    this.poses = new Poses(head);
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(0x000004);
    this.canvas = part('canvas');
    this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: true,
                                              preserveDrawingBuffer: true });
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = THREE.PCFSoftShadowMap;
    this.renderer.shadowMap.autoUpdate = false;
    this.camera = new THREE.PerspectiveCamera(40, 16 / 9, 0.05, 2000);
    this.camera.up.set(0, 0, 1);
    this.light();
    this.scene.add(this.ground.mesh());
    for (const boulder of head.boulders) {
      const rock = new THREE.Mesh(polyhedron(head, boulder),
                                  new THREE.MeshLambertMaterial({ color: 0x8a8883 }));
      rock.position.fromArray(boulder.at);
      rock.castShadow = rock.receiveShadow = true;
      this.scene.add(rock);
    }
    this.robots = new Robots(head, this.scene);
    this.targets = head.targets.map(spec => new Target(spec, head, this.ground, this.scene));
    this.mark();
    this.orbit();
    this.keys();
    this.resize();
    new ResizeObserver(() => this.resize()).observe(part('.stage'));
    this.seek(0);
  }

  light() {
    const [turn, rise] = this.head.sun, reach = Math.hypot(...this.head.half) + 2;
    const sun = new THREE.DirectionalLight(0xfff7ea, 3.6);
    sun.position.set(Math.cos(rise) * Math.cos(turn), Math.cos(rise) * Math.sin(turn),
                     Math.sin(rise)).multiplyScalar(2 * reach);
    Object.assign(sun.shadow.camera, { left: -reach, right: reach, top: reach, bottom: -reach,
                                       near: 0.1, far: 4 * reach });
    sun.shadow.mapSize.set(2048, 2048);
    sun.shadow.bias = -0.0005;
    sun.shadow.normalBias = 0.03;
    sun.castShadow = true;
    this.scene.add(sun, new THREE.HemisphereLight(0x8f95a6, 0x50483f, 0.45));
    const places = [];
    let seed = 3;
    const random = () => (seed = (seed * 16807) % 2147483647) / 2147483647;
    for (let k = 0; k < 700; k++) {
      const z = random(), a = 2 * Math.PI * random(), flat = Math.sqrt(1 - z * z);
      places.push(900 * flat * Math.cos(a), 900 * flat * Math.sin(a), 900 * z);
    }
    const stars = new THREE.BufferGeometry();
    stars.setAttribute('position', new THREE.Float32BufferAttribute(places, 3));
    this.scene.add(new THREE.Points(stars, new THREE.PointsMaterial(
      { color: 0xb8bccc, size: 1.4, sizeAttenuation: false })));
  }

  // What is drawn about the robots: rings, names, driven tracks, the ways they were sent.
  mark() {
    const [w, h] = this.head.half, ground = this.ground;
    const corners = [[-w, -h], [w, -h], [w, h], [-w, h], [-w, -h]];
    this.scene.add(ribbon(corners.slice(1).flatMap((to, k) => line(ground, corners[k], to, 0.05)),
                          0.05, '#9fb4d8', 0.5));
    for (const robot of this.robots.list) {
      robot.ring = new THREE.Mesh(
        new THREE.RingGeometry(1.05 * robot.footprint, 1.05 * robot.footprint + 0.07, 40),
        new THREE.MeshBasicMaterial({ color: robot.colour, side: THREE.DoubleSide,
                                      depthWrite: false, polygonOffset: true,
                                      polygonOffsetFactor: -4 }));
      robot.sign = label(robot.name, robot.colour);
      robot.pick = new THREE.Mesh(new THREE.SphereGeometry(Math.max(0.45, 1.2 * robot.footprint)));
      robot.pick.visible = false;
      robot.pick.userData.robot = robot;
      [robot.track, robot.trackTimes] = this.track(robot);
      robot.ways = robot.legs.filter(leg => leg[3]).map(leg => {
        const way = ribbon(line(ground, leg.slice(4, 6), leg.slice(6, 8), 0.035), 0.045,
                           robot.colour, 0.75, 1);
        way.userData.span = [leg[0], leg[1] ?? this.duration];
        return way;
      });
      this.scene.add(robot.ring, robot.sign, robot.pick, robot.track, ...robot.ways);
    }
  }

  track(robot) {
    const { numbers, times, count } = this.poses, points = [], when = [];
    for (let k = 0; k < count; k++) {
      const [x, y] = [numbers[robot.base][k], numbers[robot.base + 1][k]];
      const last = points.at(-1);
      if (last && Math.hypot(x - last[0], y - last[1]) < 0.12) continue;
      points.push([x, y, robot.flies ? numbers[robot.base + 2][k] : this.ground.height(x, y) + 0.03]);
      when.push(times[k]);
    }
    return [ribbon(points, 0.085, robot.colour, 0.9), when];
  }

  orbit() {
    const reach = Math.max(...this.head.half), middle = this.ground.height(0, 0);
    this.camera.position.set(0.3 * reach, -2.5 * reach, middle + 1.9 * reach);
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.target.set(0, -0.12 * reach, middle);
    this.controls.maxPolarAngle = 0.495 * Math.PI;
    this.controls.minDistance = 0.8;
    this.controls.maxDistance = 6 * reach;
    this.controls.update();
    this.controls.addEventListener('change', () => this.draw());
    let from = null;
    this.canvas.addEventListener('pointerdown', e => { from = [e.clientX, e.clientY]; });
    this.canvas.addEventListener('pointerup', e => {
      if (from && Math.hypot(e.clientX - from[0], e.clientY - from[1]) < 5) this.click(e);
      from = null;
    });
  }

  click(e) {
    const box = this.canvas.getBoundingClientRect(), ray = new THREE.Raycaster();
    this.scene.updateMatrixWorld();  // it may have moved since the last picture
    this.camera.updateMatrixWorld();
    ray.setFromCamera(new THREE.Vector2(2 * (e.clientX - box.left) / box.width - 1,
                                        1 - 2 * (e.clientY - box.top) / box.height), this.camera);
    const hit = ray.intersectObjects(this.robots.list.map(robot => robot.pick))[0];
    this.select(hit ? hit.object.userData.robot : null);
  }

  keys() {
    const clock = part('.clock'), pace = part('.pace'), ticks = part('.ticks');
    clock.max = this.duration;
    for (const value of PACES) pace.add(new Option(`${value} ×`, value, false, value === this.pace));
    pace.addEventListener('change', () => { this.pace = Number(pace.value); });
    clock.addEventListener('input', () => { this.pause(); this.seek(Number(clock.value)); });
    part('.play').addEventListener('click', () => this.playing ? this.pause() : this.play());
    part('.follow').addEventListener('change', () => this.near());
    for (const robot of this.robots.list) {
      const button = document.createElement('button');
      button.type = 'button';
      button.textContent = robot.name;
      button.style.color = robot.colour;
      button.addEventListener('click', () => this.select(robot));
      part('.team').append(button);
    }
    const colours = { ...this.head.colours, lost: this.head.colours.open };
    this.items = this.head.events.map(([time, kind, words]) => {
      const tick = document.createElement('i'), item = document.createElement('li');
      tick.title = item.textContent = `${time.toFixed(1)} s  ${words}`;
      tick.style.left = `${100 * time / Math.max(this.duration, 1e-6)}%`;
      tick.style.background = item.style.color = colours[kind];
      for (const one of [tick, item]) {
        one.addEventListener('click', () => { this.pause(); this.seek(time); });
      }
      ticks.append(tick);
      part('.events').append(item);
      return [time, item];
    });
  }

  resize() {
    const width = part('.stage').clientWidth;
    if (!width || width === this.width) return;
    this.width = width;
    const height = Math.round(width < 600 ? width : width * 0.58);
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(width, height, true);
    this.camera.aspect = width / height;
    // A narrow window sees as far to the sides as a wide one.
    this.camera.fov = 2 * Math.atan(Math.max(0.364, 0.63 * height / width)) * 180 / Math.PI;
    this.camera.updateProjectionMatrix();
    const tall = LABEL * 2 * Math.tan(this.camera.fov * Math.PI / 360) / height;
    this.scene.traverse(one => {
      if (one.isSprite) one.scale.set(tall * one.userData.ratio, tall, 1);
    });
    this.draw();
  }

  position(robot, time = this.now) {
    const place = this.poses.place(time);
    return [0, 1, 2].map(k => this.poses.at(robot.base + k, place));
  }

  speed(robot) {
    const from = Math.max(this.now - SPEED_WINDOW / 2, 0);
    const to = Math.min(this.now + SPEED_WINDOW / 2, this.duration);
    const [a, b] = [this.position(robot, from), this.position(robot, to)];
    return to > from ? Math.hypot(b[0] - a[0], b[1] - a[1]) / (to - from) : 0;
  }

  state(robot) {
    const now = this.now + 1e-6;
    if (robot.lost && robot.lost[0] <= now) return `lost: ${robot.lost[1]}`;
    const serving = this.targets.find(target => target.state(this.now) === 'serving'
      && target.spec.by.includes(this.robots.list.indexOf(robot)));
    if (serving) return `in service at ${serving.spec.name}`;
    const leg = robot.legs.findLast(one => one[0] <= now);
    const under = leg && (leg[1] === null || now < leg[1]);
    if (leg && !under && leg[2] === 'timeout') return 'late';
    return (leg && leg[3] && under) || this.speed(robot) > AT_REST ? 'moving' : 'waiting';
  }

  tell(robot) {
    const choice = robot.choices.findLast(one => one[0] <= this.now + 1e-6);
    const slip = this.head.array(robot.slip)[Math.round(this.now / robot.slip_every)];
    const lost = robot.lost && robot.lost[0] <= this.now;
    return [`${robot.name}, ${robot.kind} ${robot.skills.join(' ')}`, this.state(robot),
            `${this.speed(robot).toFixed(2)} m/s`,
            robot.flies || !Number.isFinite(slip) ? 'slip -' : `slip ${slip.toFixed(2).replace("-0.00", "0.00")}`,
            choice && !lost ? choice[1] : 'no choice'].join(' · ');
  }

  select(robot) {
    this.chosen = robot;
    this.near();
    this.show();
  }

  // Comes near the chosen robot, if it is to be followed.
  near() {
    if (!this.chosen || !part('.follow').checked) return;
    const away = this.camera.position.clone().sub(this.controls.target).setLength(4);
    this.controls.target.set(...this.position(this.chosen));
    this.camera.position.copy(this.controls.target).add(away);
    this.controls.update();
  }

  seek(time) {
    const before = this.chosen && this.position(this.chosen);
    this.now = Math.min(Math.max(time, 0), this.duration);
    if (before && part('.follow').checked) {
      const moved = new THREE.Vector3(...this.position(this.chosen)).sub(this.controls.target);
      this.controls.target.add(moved);
      this.camera.position.add(moved);
    }
    this.show();
    this.controls.update();
  }

  show() {
    const place = this.poses.place(this.now), now = this.now + 1e-6;
    this.robots.pose(this.poses, place);
    for (const target of this.targets) target.show(this.now);
    for (const robot of this.robots.list) {
      const [x, y, z] = this.position(robot), lost = robot.lost && robot.lost[0] <= now;
      const colour = lost ? '#8a93a6' : robot.colour, size = robot === this.chosen ? 1.5 : 1;
      robot.ring.position.set(x, y, this.ground.height(x, y) + 0.05);
      robot.ring.scale.set(size, size, 1);
      robot.ring.material.color.set(colour);
      robot.sign.position.set(x, y, z + 0.45);
      robot.pick.position.set(x, y, z);
      let gone = robot.trackTimes.findIndex(time => time > now);
      if (gone < 0) gone = robot.trackTimes.length;
      robot.track.geometry.setDrawRange(0, 6 * Math.max(gone - 1, 0));
      for (const way of robot.ways) {
        const [from, to] = way.userData.span;
        way.visible = from <= now;
        way.material.opacity = now < to ? 0.95 : 0.35;
      }
    }
    part('.clock').value = this.now;
    part('.time').textContent = `${this.now.toFixed(1)} of ${this.duration.toFixed(1)} s`;
    part('.told').textContent = this.chosen ? this.tell(this.chosen)
      : 'drag to turn, wheel to come near, click a robot';
    part('.told').style.color = this.chosen ? this.chosen.colour : '';
    for (const [time, item] of this.items) item.classList.toggle('past', time <= now);
    this.renderer.shadowMap.needsUpdate = true;
    this.draw();
  }

  // Once for all that changed since the last picture.
  draw() {
    this.asked ??= requestAnimationFrame(() => {
      this.asked = null;
      this.renderer.render(this.scene, this.camera);
    });
  }

  play() {
    if (this.now >= this.duration - 1e-6) this.seek(0);
    this.playing = true;
    part('.play').textContent = 'pause';
    let last = null;
    const step = stamp => {
      if (!this.playing) return;
      if (last !== null) this.seek(this.now + this.pace * Math.min(stamp - last, 250) / 1000);
      last = stamp;
      if (this.now >= this.duration) this.pause(); else requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  pause() {
    this.playing = false;
    part('.play').textContent = 'play';
  }

  // A point of the canvas, in the window's pixels, at which a robot is seen.
  seen(robot) {
    const box = this.canvas.getBoundingClientRect();
    this.camera.updateMatrixWorld();
    const at = new THREE.Vector3(...this.position(robot)).project(this.camera);
    return [box.left + box.width * (at.x + 1) / 2, box.top + box.height * (1 - at.y) / 2];
  }
}

function hook(replay) {
  const named = name => replay.robots.list.find(robot => robot.name === name);
  // For tests and for who wants to script the page.
  window.moonteamReplay = {
    duration: replay.duration,
    seek: time => replay.seek(time),
    play: pace => { replay.pace = pace ?? replay.pace; replay.play(); },
    pause: () => replay.pause(),
    time: () => replay.now,
    positions: () => Object.fromEntries(replay.robots.list.map(robot => {
      const at = robot.root.getWorldPosition(new THREE.Vector3());
      return [robot.name, at.toArray()];
    })),
    turns: () => replay.robots.joints.map(joint => joint.moved.quaternion.toArray()),
    states: () => Object.fromEntries(replay.targets.map(t => [t.spec.name, t.state(replay.now)])),
    select: name => replay.select(named(name)),
    selected: () => replay.chosen && replay.chosen.name,
    seen: name => replay.seen(named(name)),
    look: (from, to) => {
      replay.camera.position.set(...from);
      replay.controls.target.set(...to);
      replay.controls.update();
      replay.draw();
    },
  };
  document.dispatchEvent(new Event('moonteam-replay'));
}

try {
  hook(new Replay(await unpack(document.getElementById('replay-data').textContent)));
} catch (error) {
  part('.told').textContent = `No replay: ${error.message}`;
  part('.told').classList.add('bad');
}
