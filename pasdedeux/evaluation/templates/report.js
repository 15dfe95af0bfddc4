"use strict";
// Players: 3D motions on a canvas. Positions are int16 in units of `unit_m`, one frame after another; -32768 is "not there".
const MISSING = -32768;
let isPrinting = false;

// A colour of the page, which is dark or light as the reader has it; of what is printed the light one.
function themed(name, light) {
  return (!isPrinting && getComputedStyle(document.documentElement).getPropertyValue(name)) || light;
}

function shade(colour, factor) {
  return "rgb(" + [1, 3, 5].map((at) => Math.round(parseInt(colour.slice(at, at + 2), 16) * factor)).join(",") + ")";
}

// Vectors of three.
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const size = Math.hypot(...a) || 1; return a.map((value) => value / size); };
const turned = (rows, a) => rows.map((row) => row[0] * a[0] + row[1] * a[1] + row[2] * a[2]);

// The rotation that takes three orthonormal axes to three others.
const between = (from, to) => [0, 1, 2].map((i) => [0, 1, 2].map((j) => from[0][j] * to[0][i] + from[1][j] * to[1][i] + from[2][j] * to[2][i]));

// Axes along a, and in the plane of a and b.
function axes(a, b) {
  const x = unit(a), z = unit(cross(x, b));
  return [x, cross(z, x), z];
}

// A coarse body on joints in any pose: each vertex moves with up to four joints, at the scale of their bones.
class Skin {
  constructor(packed) {
    const bytes = Uint8Array.from(atob(packed.data), (letter) => letter.charCodeAt(0)), count = packed.num_vertices;
    this.packed = packed; this.count = count;
    this.vertices = Float32Array.from(new Int16Array(bytes.buffer, 0, 3 * count), (value) => value * packed.unit_m);
    this.joints = bytes.subarray(6 * count, 10 * count);
    this.weights = bytes.subarray(10 * count, 14 * count);
    this.faces = new Uint16Array(bytes.buffer.slice(14 * count));
    this.order = packed.parents.map((_, joint) => joint).sort((a, b) => this.depth(a) - this.depth(b));
    this.children = packed.parents.map((_, joint) => packed.parents.flatMap((parent, child) => (parent === joint ? [child] : [])));
  }

  depth(joint) { return this.packed.parents[joint] < 0 ? 0 : 1 + this.depth(this.packed.parents[joint]); }

  // Rotation of each joint from the rest pose: by three points, else by the shortest way from that of its parent.
  turns(points) {
    const { parents, rest_m: rest, turned_by: by } = this.packed, turns = [];
    for (const joint of this.order) {
      const before = parents[joint] < 0 ? [[1, 0, 0], [0, 1, 0], [0, 0, 1]] : turns[parents[joint]], [child] = this.children[joint];
      const frame = (at) => { const [left, right, up] = by[joint]; return axes(minus(at[left], at[right]), minus(at[up], at[joint])); };
      if (by[joint]) turns[joint] = between(frame(rest), frame(points));
      else if (child === undefined) turns[joint] = before;
      else {
        const was = unit(turned(before, minus(rest[child], rest[joint]))), is = unit(minus(points[child], points[joint]));
        const normal = cross(was, is), cosine = was[0] * is[0] + was[1] * is[1] + was[2] * is[2];
        if (Math.hypot(...normal) < 1e-6) { turns[joint] = before; continue; }
        const swing = between(axes(was, cross(unit(normal), was)), axes(is, cross(unit(normal), is)));
        turns[joint] = [0, 1, 2].map((i) => [0, 1, 2].map((j) => [0, 1, 2].reduce((sum, k) => sum + swing[i][k] * before[k][j], 0)));
      }
    }
    return turns;
  }

  // How long the bones at each joint are against those of the rest pose.
  scales(points) {
    const { parents, rest_m: rest } = this.packed, scales = [];
    for (const joint of this.order) {
      const ratios = this.children[joint].map((child) => Math.hypot(...minus(points[child], points[joint])) / Math.hypot(...minus(rest[child], rest[joint])));
      scales[joint] = ratios.length ? ratios.reduce((sum, value) => sum + value, 0) / ratios.length : scales[parents[joint]];
    }
    return scales;
  }

  // Vertices (n x 3) of the body with its joints at these points.
  posed(points) {
    const { rest_m: rest } = this.packed, scales = this.scales(points), out = new Float32Array(3 * this.count);
    const turns = this.turns(points).map((rows, joint) => rows.map((row) => row.map((value) => value * scales[joint])));
    const shifts = points.map((point, joint) => minus(point, turned(turns[joint], rest[joint])));
    for (let vertex = 0; vertex < this.count; vertex++) {
      const [x, y, z] = this.vertices.subarray(3 * vertex, 3 * vertex + 3);
      for (let at = 4 * vertex; at < 4 * vertex + 4 && this.weights[at]; at++) {
        const weight = this.weights[at] / 255, rows = turns[this.joints[at]], shift = shifts[this.joints[at]];
        for (let axis = 0; axis < 3; axis++) out[3 * vertex + axis] += weight * (rows[axis][0] * x + rows[axis][1] * y + rows[axis][2] * z + shift[axis]);
      }
    }
    return out;
  }
}
const packedSkins = __SKINS__, skins = {};  // by skeleton: bodies that players share
function skinOf(name) {
  if (packedSkins[name]) skins[name] ??= new Skin(packedSkins[name]);
  return skins[name];
}

class Player {
  constructor(figure) {
    this.scene = JSON.parse(figure.querySelector("script").textContent);
    const bytes = Uint8Array.from(atob(this.scene.data), (letter) => letter.charCodeAt(0));
    this.values = new Int16Array(bytes.buffer);
    this.canvas = figure.querySelector("canvas");
    this.slider = figure.querySelector("input");
    this.button = figure.querySelector("button.play");
    this.label = figure.querySelector("output");
    this.frame = 0; this.speed = 1; this.isPlaying = false;
    this.slider.max = this.scene.num_frames - 1;
    this.slider.addEventListener("input", () => { this.pause(); this.show(Number(this.slider.value)); });
    this.button.addEventListener("click", () => (this.isPlaying ? this.pause() : this.play()));
    figure.querySelector("select").addEventListener("change", (event) => { this.speed = Number(event.target.value); });
    figure.querySelector("button.home").addEventListener("click", () => this.goHome(figure.querySelector("select.view")));
    for (const [name, factor] of [["nearer", 1.25], ["farther", 0.8]])
      figure.querySelector(`button.${name}`).addEventListener("click", () => this.enlarge(factor));
    this.canvas.addEventListener("wheel", (event) => {  // with Ctrl, or two fingers: the page scrolls else
      if (event.ctrlKey) { event.preventDefault(); this.enlarge(Math.exp(-0.01 * event.deltaY)); }
    }, { passive: false });
    this.canvas.addEventListener("pointerdown", (event) => this.canvas.setPointerCapture(event.pointerId));
    this.canvas.addEventListener("pointermove", (event) => {
      if (event.buttons) this.orbit(event.movementX * 0.01, event.movementY * 0.01);
    });
    this.canvas.addEventListener("keydown", (event) => this.press(event));
    if (this.scene.num_frames < 2) figure.querySelector(".time").hidden = true;
    this.measure();
    this.frame = this.first = this.touching();
    this.home = [this.across(), this.scene.has_floor ? 0.2 : 0];
    [this.yaw, this.pitch, this.zoom] = [...this.home, 1];
    this.chooseView(figure.querySelector("select.view"));
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  goHome(list) {
    list.selectedIndex = 0;  // of several cameras: all
    this.shown = this.scene.panels;
    [this.yaw, this.pitch, this.zoom] = [...this.home, 1];
    this.draw();
  }

  // Of several cameras one is shown, beside the room as it sees it, or all of them.
  chooseView(list) {
    const views = this.scene.panels.flatMap(({ view }) => (view ? [view] : []));
    this.shown = this.scene.panels;
    if (views.length < 2) return;
    list.hidden = false;
    for (const name of ["all cameras", ...views.map(([name]) => name)]) list.add(new Option(name));
    list.addEventListener("change", () => {
      const chosen = views[list.selectedIndex - 1];
      this.shown = this.scene.panels.filter(({ view }) => !view || !chosen || view === chosen);
      [this.yaw, this.pitch] = chosen ? chosen.slice(1) : this.home;
      this.draw();
    });
  }

  press(event) {
    const turns = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
    if (event.key in turns) this.orbit(...turns[event.key]);
    else if (event.key === "+" || event.key === "-") this.enlarge(event.key === "+" ? 1.25 : 0.8);
    else if (event.key === " ") this.button.click();
    else return;
    event.preventDefault();
  }

  orbit(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.max(-1.5, Math.min(1.5, this.pitch + pitch));
    this.draw();
  }

  enlarge(factor) {
    this.zoom = Math.max(0.5, Math.min(8, this.zoom * factor));
    this.draw();
  }

  play() {
    this.isPlaying = true;
    this.button.textContent = "Pause";
    let before = null, at = this.frame;  // a frame's time may lie before that of the click
    const step = (now) => {
      if (!this.isPlaying) return;
      at = (at + ((now - (before ?? now)) / 1000) * this.scene.rate_hz * this.speed) % this.scene.num_frames;
      before = now;
      if (Math.floor(at) !== this.frame) this.show(Math.floor(at));
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  pause() { this.isPlaying = false; this.button.textContent = "Play"; }

  show(frame) {
    this.frame = frame;
    this.slider.value = frame;
    const text = this.scene.labels[frame] ?? (frame / this.scene.rate_hz).toFixed(1) + " s";
    this.label.textContent = text;
    this.slider.setAttribute("aria-valuetext", text);
    this.draw();
  }

  point(index) {
    const at = 3 * (this.frame * this.scene.num_points + index), unit = this.scene.unit_m, values = this.values;
    return values[at] === MISSING ? null : [values[at] * unit, values[at + 1] * unit, values[at + 2] * unit];
  }

  // The frame in the middle, or the one nearest to it with the most contacts.
  touching() {
    const middle = Math.floor(this.scene.num_frames / 2);
    const links = this.scene.panels.flatMap((panel) => panel.lines.filter((lines) => lines.width === 2));
    const starts = links.flatMap((lines) => Array.from({ length: lines.num_lines }, (_, at) => lines.start + 2 * at));
    let best = middle, most = -1;
    for (let frame = 0; frame < this.scene.num_frames; frame++) {
      this.frame = frame;
      const count = starts.filter((at) => this.point(at)).length;
      if (count > most || (count === most && Math.abs(frame - middle) < Math.abs(best - middle))) [best, most] = [frame, count];
    }
    return best;
  }

  // The first view is across the line between two people on a floor; what a camera saw is shown as it did.
  across() {
    const { panels, has_floor: hasFloor } = this.scene, people = panels[0]?.figures.filter((figure) => !figure.is_thin) ?? [];
    if (!hasFloor || people.length !== 2 || panels.some((panel) => panel.is_flat)) return 0;
    const [a, b] = people.map((figure) => this.middle({ figures: [figure], lines: [] })?.at);
    const yaw = a && b ? Math.atan2(b[2] - a[2], b[0] - a[0]) : 0;
    return yaw > Math.PI / 2 ? yaw - Math.PI : yaw < -Math.PI / 2 ? yaw + Math.PI : yaw;
  }

  // Each panel looks at the middle of its people; all panels have one scale, which holds everybody at all times.
  middle(panel) {
    let low = [Infinity, Infinity, Infinity], high = low.map((value) => -value);
    for (const part of panel.is_flat ? [...panel.figures, ...panel.lines] : panel.figures)
      for (let index = 0; index < (part.num_points ?? 2 * part.num_lines); index++) {
        const point = this.point(part.start + index);
        if (point) { low = low.map((v, i) => Math.min(v, point[i])); high = high.map((v, i) => Math.max(v, point[i])); }
      }
    return low[0] > high[0] ? null : { low, high, at: low.map((value, axis) => (value + high[axis]) / 2) };
  }

  measure() {
    this.reach = 0.2; this.bottom = Infinity; this.top = -Infinity;
    for (this.frame = this.scene.num_frames - 1; this.frame >= 0; this.frame--)
      for (const panel of this.scene.panels) {
        const box = this.middle(panel);
        if (!box) continue;
        if (panel.is_flat) {
          panel.reach = Math.max(panel.reach ?? 1e-3, box.high[0], -box.low[0]);
          panel.half = Math.max(panel.half ?? 1e-3, box.high[1], -box.low[1]);
          continue;
        }
        this.reach = Math.max(this.reach, (box.high[0] - box.low[0]) / 2, (box.high[2] - box.low[2]) / 2);
        this.bottom = Math.min(this.bottom, box.low[1]);
        this.top = Math.max(this.top, box.high[1]);
      }
    this.frame = 0;
    if (this.top < this.bottom) [this.bottom, this.top] = [-1, 1];
  }

  draw() {
    const ratio = window.devicePixelRatio || 1, width = this.canvas.clientWidth, panels = this.shown;
    if (!width) return;
    const columns = Math.max(1, Math.min(panels.length, Math.floor(width / 150)));
    const rows = Math.ceil(panels.length / columns), cell = width / columns, tall = Math.min(340, Math.max(190, cell));
    this.canvas.style.height = rows * tall + "px";
    this.canvas.width = width * ratio;
    this.canvas.height = rows * tall * ratio;
    const pen = this.canvas.getContext("2d");
    pen.scale(ratio, ratio);
    pen.lineCap = "round";
    panels.forEach((panel, index) => {
      pen.save();
      pen.translate((index % columns) * cell, Math.floor(index / columns) * tall);
      pen.beginPath();
      pen.rect(0, 0, cell, tall);
      pen.clip();
      this.drawPanel(pen, panel, cell, tall);
      pen.restore();
    });
  }

  // Draw bodies, lit from above left: pixels of their triangles, the nearest of each, twice as fine as the screen has them.
  clothe(pen, bodies, project, width, height) {
    const fine = 2 * (window.devicePixelRatio || 1), wide = Math.ceil(fine * width), tall = Math.ceil(fine * height);
    const sheet = Object.assign(document.createElement("canvas"), { width: wide, height: tall }), pane = sheet.getContext("2d");
    const image = pane.createImageData(wide, tall), pixels = new Uint32Array(image.data.buffer), near = new Float32Array(wide * tall).fill(-Infinity);
    for (const { skin, joints, colour } of bodies) {
      const vertices = skin.posed(joints), { faces } = skin, shades = skin.packed.shades;
      const placed = Array.from({ length: skin.count }, (_, at) => project(vertices.subarray(3 * at, 3 * at + 3)));
      const [red, green, blue] = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
      for (let at = 0; at < faces.length; at += 3) {
        const [a, b, c] = [placed[faces[at]], placed[faces[at + 1]], placed[faces[at + 2]]], scale = this.scale;
        const area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        if (area >= 0) continue;
        const [x, y, z] = unit(cross([b[0] - a[0], a[1] - b[1], scale * (b[2] - a[2])], [c[0] - a[0], a[1] - c[1], scale * (c[2] - a[2])]));
        const light = shades[skin.joints[4 * faces[at]]] * (0.62 + 0.38 * (-0.36 * x + 0.72 * y + 0.6 * z));
        const paint = (0xff000000 | ((blue * light) << 16) | (((green * light) & 255) << 8) | ((red * light) & 255)) >>> 0;
        const [left, right] = [Math.min(a[0], b[0], c[0]), Math.max(a[0], b[0], c[0])].map((value) => Math.round(fine * value));
        const [top, bottom] = [Math.min(a[1], b[1], c[1]), Math.max(a[1], b[1], c[1])].map((value) => Math.round(fine * value));
        for (let row = Math.max(0, top); row <= Math.min(bottom, tall - 1); row++)
          for (let column = Math.max(0, left); column <= Math.min(right, wide - 1); column++) {
            const px = (column + 0.5) / fine - a[0], py = (row + 0.5) / fine - a[1];
            const v = (px * (c[1] - a[1]) - py * (c[0] - a[0])) / area, w = ((b[0] - a[0]) * py - (b[1] - a[1]) * px) / area;
            if (v < -0.001 || w < -0.001 || v + w > 1.001) continue;
            const deep = a[2] + v * (b[2] - a[2]) + w * (c[2] - a[2]), place = row * wide + column;
            if (deep > near[place]) { near[place] = deep; pixels[place] = paint; }
          }
      }
    }
    pane.putImageData(image, 0, 0);
    pen.drawImage(sheet, 0, 0, wide / fine, tall / fine);
  }

  drawPanel(pen, panel, width, height) {
    const box = this.middle(panel), isFlat = panel.is_flat, half = isFlat ? panel.half : (this.top - this.bottom) / 2;
    const scale = this.scale = this.zoom * Math.min((0.46 * width) / (isFlat ? panel.reach : 1.15 * this.reach), (0.43 * (height - 20)) / half);
    const up = isFlat ? 0 : (this.top + this.bottom) / 2;
    const centre = box && !isFlat ? [box.at[0], up, box.at[2]] : [0, up, 0];
    const yaw = isFlat ? 0 : this.yaw, pitch = isFlat ? 0 : this.pitch;
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    const project = (p) => {
      const x = p[0] - centre[0], y = p[1] - centre[1], z = p[2] - centre[2];
      const right = cy * x + sy * z, deep = -sy * x + cy * z;
      return [width / 2 + scale * right, 20 + (height - 20) / 2 - scale * (cp * y - sp * deep), cp * deep + sp * y];
    };
    const line = (a, b, colour, thick) => {
      pen.strokeStyle = colour; pen.lineWidth = thick;
      pen.beginPath(); pen.moveTo(a[0], a[1]); pen.lineTo(b[0], b[1] + (a[0] === b[0] && a[1] === b[1] ? 0.01 : 0)); pen.stroke();
    };
    if (this.scene.has_floor && !isFlat) {
      const floor = themed("--floor", "#c3cad3");
      const [x, z] = [Math.round(centre[0]), Math.round(centre[2])], far = Math.ceil(this.reach) + 1;
      for (let i = -far; i <= far; i++) {
        line(project([x + i, 0, z - far]), project([x + i, 0, z + far]), floor, 1);
        line(project([x - far, 0, z + i]), project([x + far, 0, z + i]), floor, 1);
      }
    }
    const strokes = [], marks = [], bodies = [];
    for (const figure of panel.figures) {
      const { bones, head, body } = this.scene.skeletons[figure.skeleton], skin = figure.radii_m?.length && skinOf(body);
      const joints = skin && Array.from({ length: figure.num_points }, (_, index) => this.point(figure.start + index));
      if (skin && joints.every(Boolean)) { bodies.push({ skin, joints, colour: figure.colour }); continue; }
      for (const [parent, child, factor] of bones) {
        const a = this.point(figure.start + parent), b = this.point(figure.start + child);
        const thick = figure.radii_m?.length ? 2 * figure.radii_m[child] * scale : figure.is_thin ? 1.5 : 3;
        if (a && b) strokes.push([project(a), project(b), shade(figure.colour, factor), thick]);
      }
      const top = this.point(figure.start + head);
      if (top) strokes.push([project(top), project(top), figure.colour, figure.is_thin ? 4 : Math.max(5, (isFlat ? 0.05 : 0.13) * scale)]);
    }
    for (const lines of panel.lines)
      for (let i = 0; i < lines.num_lines; i++) {
        const a = this.point(lines.start + 2 * i), b = this.point(lines.start + 2 * i + 1);
        if (a && b) (lines.width > 2 || isFlat ? strokes : marks).push([project(a), project(b), lines.colour, lines.width]);
      }
    strokes.sort((one, other) => one[0][2] + one[1][2] - other[0][2] - other[1][2]);
    const away = bodies.length ? bodies.reduce((sum, { joints }) => sum + project(joints[0])[2] / bodies.length, 0) : -Infinity;
    const behind = strokes.filter(([a, b, , thick]) => thick > 4 && a[2] + b[2] < 2 * away);  // thin people are seen through bodies
    const paint = (list) => {
      for (const [a, b, colour, thick] of list) {
        if (thick > 6) line(a, b, shade(colour, 0.6), thick + 2);
        line(a, b, colour, thick);
      }
    };
    paint(behind);
    if (bodies.length) this.clothe(pen, bodies, project, width, height);
    paint(strokes.filter((stroke) => !behind.includes(stroke)));
    for (const [a, b, colour, thick] of marks) {
      line(a, b, colour, thick);
      for (const end of [a, b]) { line(end, end, "#ffffff", 9); line(end, end, colour, 7); }
    }
    pen.fillStyle = themed("--ink", "#1c2430");
    pen.font = "12px system-ui, sans-serif";
    pen.fillText(panel.title, 4, 14, width - 8);
  }
}

// A player is made when it comes near the screen, so that a page of hundreds opens at once; all are for print.
const players = new Map();
function ready(figure) {
  if (!players.has(figure)) {
    players.set(figure, new Player(figure));
    const player = players.get(figure);
    player.show(player.first);
  }
  return players.get(figure);
}
const near = new IntersectionObserver((seen) => {
  for (const one of seen) {
    if (one.isIntersecting) {
      const isNew = !players.has(one.target), player = ready(one.target);
      if (isNew && one.target.matches(".moving") && !matchMedia("(prefers-reduced-motion: reduce)").matches) player.play();
    }
    else players.get(one.target)?.pause();
  }
}, { rootMargin: "300px" });
document.querySelectorAll("figure.player").forEach((figure) => near.observe(figure));
window.addEventListener("beforeprint", () => {
  document.querySelectorAll("details.topic").forEach((one) => { one.open = true; });
  document.querySelectorAll("figure.player").forEach(ready);
  redraw(true);
});
window.addEventListener("afterprint", () => redraw(false));
function redraw(forPrint) {
  isPrinting = forPrint;
  players.forEach((player) => player.draw());
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => redraw(isPrinting));

// A link opens the section that it leads to.
function unfold() {
  const one = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  const topic = one && one.closest("details.topic");
  if (topic) { topic.open = true; one.scrollIntoView(); }
}
window.addEventListener("hashchange", unfold);
unfold();

// Tables: sort by a column, keep rows that hold a word, copy as CSV.
function asNumber(text) {
  const value = parseFloat(text.replace(/,/g, ""));
  return Number.isNaN(value) ? Infinity : value;
}

document.querySelectorAll("details.table").forEach((folded) => {
  const table = folded.querySelector("table"), body = table.tBodies[0], rows = [...body.rows];
  folded.querySelector("input")?.addEventListener("input", (event) => {
    const wanted = event.target.value.toLowerCase().split(/\s+/);
    for (const row of rows) row.hidden = !wanted.every((word) => row.textContent.toLowerCase().includes(word));
  });
  table.querySelectorAll("th button").forEach((button, column) => {
    button.addEventListener("click", () => {
      const heading = button.parentElement, sign = heading.ariaSort === "ascending" ? -1 : 1;
      for (const other of table.querySelectorAll("th")) other.ariaSort = "none";
      heading.ariaSort = sign > 0 ? "ascending" : "descending";
      const cell = (row) => row.cells[column].textContent;
      const compare = (a, b) => {
        const [x, y] = [asNumber(cell(a)), asNumber(cell(b))];
        return x === y ? cell(a).localeCompare(cell(b), "en", { numeric: true }) : x - y;
      };
      body.append(...[...body.rows].sort((a, b) => sign * compare(a, b)));
    });
  });
  folded.querySelector("button.copy").addEventListener("click", async (event) => {
    const plain = (text) => /^[=+\-@]/.test(text) && isNaN(text) ? "'" + text : text; // shown, not computed
    const lines = [...table.rows].filter((row) => !row.hidden).map((row) =>
      [...row.cells].map((cell) => '"' + plain(cell.textContent.trim()).replace(/"/g, '""') + '"').join(","));
    const text = document.createElement("textarea");
    text.value = lines.join("\n") + "\n";
    document.body.append(text);
    text.select();
    document.execCommand("copy");
    text.remove();
    event.target.textContent = "Copied";
    setTimeout(() => { event.target.textContent = "Copy as CSV"; }, 1500);
  });
});
