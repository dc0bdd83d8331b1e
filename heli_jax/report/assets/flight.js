// A flight in 3D on a canvas: turned by dragging or by keys, played at any speed, its time shared
// with the figures below.
"use strict";
(() => {
  const { numbers, array, point, listen } = window.heliCharts;
  const VIEWS = { "three-quarter": [0.785, 0.45], side: [1.42, 0.25], behind: [0, 0.3], above: [0, 1.5] };
  const style = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const night = matchMedia("(prefers-color-scheme: dark)");
  const NIGHT = { "#D55E00": "#e8762c", "#6B6B6B": "#b9b9b9" };
  const TIME = "time [s]";

  // A vector of body axes (forward, right, down) turned by a quaternion, in forward, left and up.
  function turned([x, y, z], [a, b, c, w]) {
    const tx = 2 * (b * z - c * y), ty = 2 * (c * x - a * z), tz = 2 * (a * y - b * x);
    return [x + w * tx + b * tz - c * ty, -(y + w * ty + c * tx - a * tz), -(z + w * tz + a * ty - b * tx)];
  }

  class Flight {
    constructor(box, scene) {
      this.box = box;
      this.scene = scene;
      this.times = array(scene.times);
      this.path = scene.path.map(array);
      this.turns = scene.turns.map(array);
      this.canvas = box.querySelector("canvas");
      this.ctx = this.canvas.getContext("2d");
      this.middle = [0, 1, 2].map(i => (scene.bounds[0][i] + scene.bounds[1][i]) / 2);
      this.radius = Math.hypot(...[0, 1, 2].map(i => scene.bounds[1][i] - scene.bounds[0][i])) / 2;
      [this.yaw, this.pitch] = VIEWS["three-quarter"];
      this.near = 1;
      this.time = this.times[0];
      this.playing = 0;
      this.controls();
      new ResizeObserver(() => this.draw()).observe(this.canvas);
      night.addEventListener("change", () => this.draw());
    }

    get end() { return this.times.at(-1); }

    controls() {
      const get = name => this.box.querySelector(`[data-role=${name}]`);
      this.button = get("play");
      this.slider = get("time");
      this.said = get("said");
      this.speed = get("speed");
      this.slider.min = this.times[0];
      this.slider.max = this.end;
      this.slider.step = "any";
      this.button.addEventListener("click", () => this.toggle());
      this.slider.addEventListener("input", () => { this.stop(); this.show(+this.slider.value); });
      // A slider without steps moves by a hundredth; a key shall move it by a sample of note.
      this.slider.addEventListener("keydown", event => {
        const by = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10 }[event.key];
        if (!by) return;
        event.preventDefault();
        this.stop();
        this.show(this.time + by * (this.end - this.times[0]) / 200);
      });
      for (const b of this.box.querySelectorAll("[data-view]")) {
        b.addEventListener("click", () => { [this.yaw, this.pitch] = VIEWS[b.dataset.view]; this.near = 1; this.draw(); });
      }
      this.canvas.addEventListener("keydown", event => this.key(event));
      this.canvas.addEventListener("pointerdown", event => {
        this.held = [event.clientX, event.clientY];
        this.canvas.setPointerCapture(event.pointerId);
      });
      this.canvas.addEventListener("pointermove", event => {
        if (!this.held) return;
        this.turn(-(event.clientX - this.held[0]) / 150, (event.clientY - this.held[1]) / 150);
        this.held = [event.clientX, event.clientY];
      });
      for (const name of ["pointerup", "pointercancel"]) this.canvas.addEventListener(name, () => { this.held = null; });
      this.canvas.addEventListener("wheel", event => {
        // A page that is scrolled past a flight shall go on scrolling.
        if (document.activeElement !== this.canvas && !event.ctrlKey) return;
        event.preventDefault();
        this.closer(Math.exp(-event.deltaY / 600));
      }, { passive: false });
      this.show(this.time, true);
    }

    // Space where nothing has the focus: the page would scroll, and says that space plays.
    keyOfPage(event) {
      const idle = !document.activeElement || document.activeElement === document.body;
      if (event.key !== " " || !idle || event.ctrlKey || event.metaKey || event.altKey || event.shiftKey) return;
      this.toggle();
      event.preventDefault();
    }

    key(event) {
      const turn = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
      if (turn) this.turn(...turn);
      else if (event.key === " ") this.toggle();
      else if (event.key === "+" || event.key === "=") this.closer(1.2);
      else if (event.key === "-") this.closer(1 / 1.2);
      else return;
      event.preventDefault();
    }

    turn(yaw, pitch) {
      this.yaw += yaw;
      this.pitch = Math.min(1.55, Math.max(-0.2, this.pitch + pitch));
      this.draw();
    }

    closer(factor) {
      this.near = Math.min(12, Math.max(0.5, this.near * factor));
      this.draw();
    }

    toggle() { if (this.playing) this.stop(); else this.play(); }

    play() {
      if (this.time >= this.end) this.show(this.times[0]);
      this.button.textContent = "Pause";
      let before = performance.now();
      const step = now => {
        this.show(this.time + (now - before) / 1000 * this.speed.value);
        before = now;
        if (this.time >= this.end) this.stop();
        else this.playing = requestAnimationFrame(step);
      };
      this.playing = requestAnimationFrame(step);
    }

    stop() {
      cancelAnimationFrame(this.playing);
      this.playing = 0;
      this.button.textContent = "Play";
    }

    // quiet: the figures' cursors stay, where these were what moved the flight.
    show(time, quiet = false) {
      this.time = Math.min(this.end, Math.max(this.times[0], time));
      this.slider.value = this.time;
      const [x, y, z] = this.at().place;
      this.said.textContent = `${this.time.toFixed(2)} s`;
      this.slider.setAttribute("aria-valuetext",
        `${this.time.toFixed(2)} s: forward ${x.toFixed(1)}, right ${(-y).toFixed(1)}, height ${z.toFixed(1)} m`);
      if (!quiet) point(TIME, this.time);
      this.draw();
    }

    at() {
      let low = 0, high = this.times.length - 1;
      while (high - low > 1) {
        const m = (low + high) >> 1;
        if (this.times[m] <= this.time) low = m; else high = m;
      }
      const part = Math.min(1, Math.max(0, (this.time - this.times[low]) / (this.times[high] - this.times[low] || 1)));
      const between = v => v[low] + part * (v[high] - v[low]);
      const q = this.turns.map(between), size = Math.hypot(...q);
      return { place: this.path.map(between), turn: q.map(v => v / size), index: low };
    }

    // From the flight's axes to pixels, and how far away.
    project([x, y, z]) {
      const a = x - this.middle[0], b = y - this.middle[1], c = z - this.middle[2];
      const { sin: sy, cos: cy } = { sin: Math.sin(this.yaw), cos: Math.cos(this.yaw) };
      const sp = Math.sin(this.pitch), cp = Math.cos(this.pitch);
      const ahead = cy * a + sy * b, left = -sy * a + cy * b;
      const depth = cp * ahead - sp * c, up = sp * ahead + cp * c;
      const scale = this.scale / (1 + 0.28 * depth / this.radius);
      return [this.centre[0] - left * scale, this.centre[1] - up * scale, depth];
    }

    // As large as the canvas holds the room with its numbers, whichever way it is turned.
    fit() {
      this.scale = 1;
      this.centre = [0, 0];
      const { bounds } = this.scene, seen = [];
      for (let k = 0; k < 8; k++) seen.push(this.project([0, 1, 2].map(i => bounds[(k >> i) & 1][i])));
      const [left, right, top, bottom] = [0, 0, 1, 1].map((i, k) => Math[k % 2 ? "max" : "min"](...seen.map(p => p[i])));
      const room = [this.width - 110, this.height - 90];
      this.scale = Math.min(room[0] / (right - left), room[1] / (bottom - top)) * this.near;
      this.centre = [this.width / 2 + 8 - (left + right) / 2 * this.scale, this.height / 2 - 4 - (top + bottom) / 2 * this.scale];
    }

    line(points, color, width) {
      this.ctx.beginPath();
      points.forEach((p, i) => { const [x, y] = this.project(p); if (i) this.ctx.lineTo(x, y); else this.ctx.moveTo(x, y); });
      this.ctx.strokeStyle = color;
      this.ctx.lineWidth = width;
      this.ctx.stroke();
    }

    draw() {
      const { ctx, canvas } = this, ratio = devicePixelRatio || 1;
      [this.width, this.height] = [canvas.clientWidth, canvas.clientHeight];
      if (!this.width) return;
      if (canvas.width !== Math.round(this.width * ratio) || canvas.height !== Math.round(this.height * ratio)) {
        canvas.width = Math.round(this.width * ratio);
        canvas.height = Math.round(this.height * ratio);
      }
      this.fit();
      ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
      ctx.clearRect(0, 0, this.width, this.height);
      ctx.lineJoin = "round";
      this.room();
      const moment = this.at(), [low] = this.scene.bounds;
      const trail = (to, floor) => {
        const points = [], stride = Math.max(1, Math.floor(this.times.length / 1500));
        for (let i = 0; i < to; i += stride) points.push([this.path[0][i], this.path[1][i], floor ? low[2] : this.path[2][i]]);
        return points;
      };
      const n = this.times.length;
      this.line(trail(n, true), style("--line"), 2.5);
      this.line(trail(n, false), style("--quiet"), 1);
      this.line([...trail(moment.index + 1, false), moment.place], style("--link"), 3);
      const [x, y, z] = moment.place;
      this.line([[x, y, z], [x, y, low[2]]], style("--line"), 1);
      this.machine(moment);
    }

    // The floor and the two walls that face the viewer, with their numbers.
    room() {
      const { bounds: [low, high], ticks } = this.scene, { ctx } = this;
      const grid = style("--grid"), ink = style("--quiet");
      // The walls behind what is seen: those on the far side of the middle.
      const far = [Math.cos(this.yaw) >= 0 ? high[0] : low[0], Math.sin(this.yaw) >= 0 ? high[1] : low[1]];
      const near = [far[0] === high[0] ? low[0] : high[0], far[1] === high[1] ? low[1] : high[1]];
      for (const v of ticks[0]) { this.line([[v, low[1], low[2]], [v, high[1], low[2]]], grid, 1); this.line([[v, far[1], low[2]], [v, far[1], high[2]]], grid, 1); }
      for (const v of ticks[1]) { this.line([[low[0], v, low[2]], [high[0], v, low[2]]], grid, 1); this.line([[far[0], v, low[2]], [far[0], v, high[2]]], grid, 1); }
      for (const v of ticks[2]) { this.line([[far[0], low[1], v], [far[0], high[1], v]], grid, 1); this.line([[low[0], far[1], v], [high[0], far[1], v]], grid, 1); }
      ctx.fillStyle = ink;
      ctx.font = "11px system-ui, sans-serif";
      ctx.textAlign = "center";
      ctx.textBaseline = "middle";
      const taken = [];
      // Words that would lie over others are left out: titles come first, then numbers.
      const put = (text, x, y) => {
        const half = ctx.measureText(text).width / 2 + 3, right = ctx.textAlign === "right" ? half : 0;
        const here = { x: x - right, y, half };
        if (taken.some(o => Math.abs(o.x - here.x) < o.half + half && Math.abs(o.y - y) < 12)) return;
        taken.push(here);
        ctx.fillText(text, x, y);
      };
      const write = (text, p, away) => {
        const [x, y] = this.project(p), [mx, my] = this.project([this.middle[0], this.middle[1], p[2]]);
        const size = Math.hypot(x - mx, y - my) || 1;
        put(text, x + away * (x - mx) / size, y + away * Math.max(0.3, (y - my) / size));
      };
      const text = v => String(+v.toPrecision(6)).replace("-", "−");
      const middle = this.middle;
      write("forward [m]", [middle[0], near[1], low[2]], 34);
      write("right [m]", [near[0], middle[1], low[2]], 34);
      for (const v of ticks[0]) write(text(v), [v, near[1], low[2]], 13);
      for (const v of ticks[1]) write(text(-v || 0), [near[0], v, low[2]], 13);
      // Height stands at the edge that is furthest to the left.
      const corners = [[far[0], near[1]], [near[0], far[1]]].map(c => [...c, low[2]]);
      const [edge] = corners.sort((a, b) => this.project(a)[0] - this.project(b)[0]);
      ctx.textAlign = "right";
      for (const v of ticks[2]) { const [x, y] = this.project([edge[0], edge[1], v]); put(text(v), x - 6, y); }
      const [x, y] = this.project([edge[0], edge[1], high[2]]);
      ctx.textAlign = "left";
      ctx.fillText("height [m]", Math.max(2, x - 30), y - 12);
    }

    machine({ place, turn }) {
      const { ctx } = this, faces = [];
      const put = p => { const q = turned(p, turn); return [q[0] + place[0], q[1] + place[1], q[2] + place[2]]; };
      for (const part of this.scene.parts) {
        const points = part.points.map(put), seen = points.map(p => this.project(p));
        const color = (night.matches && NIGHT[part.color]) || part.color;
        for (const face of part.faces) {
          const [a, b, c] = face.map(i => points[i]);
          const u = [0, 1, 2].map(i => b[i] - a[i]), v = [0, 1, 2].map(i => c[i] - a[i]);
          const up = u[0] * v[1] - u[1] * v[0], normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], up];
          faces.push({ corners: face.map(i => seen[i]), depth: face.reduce((sum, i) => sum + seen[i][2], 0) / 3,
            light: 0.62 + 0.38 * Math.abs(up) / (Math.hypot(...normal) || 1), color, alpha: part.alpha });
        }
      }
      // Painted from far to near.
      faces.sort((a, b) => b.depth - a.depth);
      for (const outline of this.scene.outlines) this.line(outline.map(put), style("--ink"), 1.6);
      for (const f of faces) {
        ctx.beginPath();
        f.corners.forEach(([x, y], i) => i ? ctx.lineTo(x, y) : ctx.moveTo(x, y));
        ctx.closePath();
        ctx.globalAlpha = f.alpha;
        const [r, g, b] = [1, 3, 5].map(i => Math.round(f.light * parseInt(f.color.slice(i, i + 2), 16)));
        ctx.fillStyle = `rgb(${r} ${g} ${b})`;
        ctx.fill();
        // Without an edge of its own colour the page would show through between two faces.
        if (f.alpha === 1) { ctx.strokeStyle = ctx.fillStyle; ctx.lineWidth = 0.6; ctx.stroke(); }
      }
      ctx.globalAlpha = 1;
    }
  }

  const flights = [...document.querySelectorAll(".flight[data-scene]")].map(box => {
    for (const hidden of box.querySelectorAll("[hidden]")) hidden.hidden = false;
    return new Flight(box, numbers.scenes[+box.dataset.scene]);
  });
  // Of several the one in view.
  document.addEventListener("keydown", event => {
    const seen = flights.find(f => f.canvas.getBoundingClientRect().bottom > 0) ?? flights.at(-1);
    seen?.keyOfPage(event);
  });
  listen((chart, time) => {
    if (chart.x_label !== TIME) return;
    for (const f of flights) { f.stop(); f.show(time, true); }
  });
  window.heliFlights = flights;
})();
