"use strict";
/* Cursor, zoom and numbers of the page's figures. The pictures are whole without it. */
(() => {
  const SVG = document.querySelector("svg")?.namespaceURI; /* the page holds no address */
  const make = (name, attributes = {}, text = "") => {
    const element = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (text) element.textContent = text;
    return element;
  };

  /* Numbers, written as multiples of a power of ten: see servolens.report.figure_data.encoded */
  const decoded = (code) => {
    const tenths = code.e < 0 ? 10 ** -code.e : 10 ** code.e;
    const number = (whole) => (code.e < 0 ? whole / tenths : whole * tenths);
    if (code.n !== undefined) return Array.from({length: code.n}, (_, i) => number(Math.round(code.from + i * code.step)));
    let whole = 0;
    return code.d.map((step) => (step === null ? NaN : number((whole += step))));
  };
  const short = (value) => {
    if (!Number.isFinite(value)) return "–";
    const text = String(Number(value.toPrecision(4)));
    return text.replace("-", "−");
  };

  /* Round numbers within a range; of a logarithmic one powers of ten and what is between them */
  const ticksOf = (low, high, isLog) => {
    const [first, last] = low < high ? [low, high] : [high, low];
    if (isLog && last - first > 0.7) {
      const found = [];
      for (let p = Math.floor(first); p <= last; p++) {
        for (const m of last - first > 3 ? [1] : [1, 2, 5]) {
          const place = p + Math.log10(m);
          if (place >= first && place <= last) found.push([place, m * 10 ** p]);
        }
      }
      return found;
    }
    const [a, b] = isLog ? [10 ** first, 10 ** last] : [first, last];
    const rough = (b - a) / 5, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].find((m) => m * power >= rough * 0.999) * power;
    const found = [];
    for (let k = Math.ceil(a / step - 1e-9); k * step <= b * (1 + 1e-12) + 1e-9 * step; k++) {
      found.push([isLog ? Math.log10(k * step) : k * step, k * step]);
    }
    return found;
  };

  class Panel {
    constructor(group, told) {
      this.group = group;
      this.title = told.title;
      this.box = told.box;
      this.lines = told.lines.map((line) => ({label: line.label, colour: line.colour, x: decoded(line.x), y: decoded(line.y)}));
      this.scales = {x: told.x, y: told.y};
      this.whole = {x: this.ends(told.x), y: this.ends(told.y)};
      this.seen = {x: [...this.whole.x], y: [...this.whole.y]};
      this.marks = make("g", {class: "cursor"});
      group.append(this.marks);
    }
    ends(scale) {
      return scale.kind === "log" ? [Math.log10(scale.low), Math.log10(scale.high)] : [scale.low, scale.high];
    }
    inScale(axis, value) {
      return this.scales[axis].kind === "log" ? Math.log10(value) : value;
    }
    place(axis, value) {
      const [low, high] = this.seen[axis], share = (this.inScale(axis, value) - low) / (high - low);
      const [left, top, width, height] = this.box;
      return axis === "x" ? left + share * width : top + (1 - share) * height;
    }
    at(axis, position) {
      const [left, top, width, height] = this.box, [low, high] = this.seen[axis];
      const share = axis === "x" ? (position - left) / width : 1 - (position - top) / height;
      return low + share * (high - low);
    }
    holds(x, y) {
      const [left, top, width, height] = this.box;
      return x >= left && x <= left + width && y >= top && y <= top + height;
    }
    get isZoomed() {
      return ["x", "y"].some((axis) => this.seen[axis].some((end, i) => end !== this.whole[axis][i]));
    }
    see(ranges) {
      for (const axis of ["x", "y"]) {
        if (this.scales[axis].kind !== "named" && ranges[axis]) this.seen[axis] = ranges[axis];
      }
      this.redraw();
    }
    /* Move what was drawn: lines and areas are stretched, marks only shifted */
    redraw() {
      const [left, top, width, height] = this.box, map = {};
      for (const axis of ["x", "y"]) {
        const [low, high] = this.whole[axis], [from, to] = this.seen[axis];
        const stretch = (high - low) / (to - from), size = axis === "x" ? width : height;
        const start = axis === "x" ? left : top;
        const share = axis === "x" ? (from - low) / (high - low) : 1 - (to - low) / (high - low);
        map[axis] = {stretch, shift: start - (start + share * size) * stretch};
      }
      if (!this.moved) this.wrap();
      const matrix = `matrix(${map.x.stretch} 0 0 ${map.y.stretch} ${map.x.shift} ${map.y.shift})`;
      for (const group of this.moved) group.setAttribute("transform", matrix);
      for (const [mark, x, y] of this.points) {
        mark.setAttribute("x", x * map.x.stretch + map.x.shift);
        mark.setAttribute("y", y * map.y.stretch + map.y.shift);
      }
      this.group.classList.toggle("zoomed", this.isZoomed);
      for (const axis of ["x", "y"]) {
        this.group.classList.toggle(`zoomed-${axis}`, this.isZoomed && this.scales[axis].kind !== "named");
      }
      this.drawTicks();
    }
    wrap() {
      this.moved = [];
      this.points = [];
      for (const element of [...this.group.querySelectorAll("[clip-path]")]) {
        if (element.closest('[class^="xtick"], [class^="ytick"]')) continue;
        const marks = [...element.querySelectorAll("use")].filter((use) => Number(use.getAttribute("x")) !== 0);
        if (marks.length) {
          for (const use of marks) this.points.push([use, Number(use.getAttribute("x")), Number(use.getAttribute("y"))]);
          continue;
        }
        const outer = make("g", {"clip-path": element.getAttribute("clip-path")}), inner = make("g", {class: "moved"});
        element.replaceWith(outer);
        outer.append(inner);
        inner.append(element);
        element.removeAttribute("clip-path");
        this.moved.push(inner);
      }
    }
    drawTicks() {
      this.ticks?.remove();
      if (!this.isZoomed) return;
      this.ticks = make("g", {class: "ticks"});
      const [left, top, width, height] = this.box;
      for (const axis of ["x", "y"]) {
        if (this.scales[axis].kind === "named") continue;
        for (const [place, value] of ticksOf(...this.seen[axis], this.scales[axis].kind === "log")) {
          const isLog = this.scales[axis].kind === "log", at = this.place(axis, isLog ? 10 ** place : place);
          const grid = axis === "x" ? `M${at} ${top}V${top + height}` : `M${left} ${at}H${left + width}`;
          this.ticks.append(make("path", {d: grid, class: "grid"}));
          const spot = axis === "x" ? {x: at, y: top + height + 12, "text-anchor": "middle"} : {x: left - 5, y: at + 3, "text-anchor": "end"};
          if (this.scales[axis].told) this.ticks.append(make("text", spot, short(value)));
        }
      }
      this.group.prepend(this.ticks);
      const background = this.group.querySelector("g, path");
      if (background === this.ticks) this.group.insertBefore(this.ticks, this.ticks.nextSibling.nextSibling);
    }
    /* Mark the samples nearest to a place, and say them */
    point(x, focused) {
      this.marks.replaceChildren();
      if (x === null) return null;
      const [left, top, width, height] = this.box, at = this.place("x", this.scales.x.kind === "log" ? 10 ** x : x);
      this.marks.append(make("path", {d: `M${at} ${top}V${top + height}`, class: "hair"}));
      const told = [];
      for (const line of this.lines) {
        const k = this.nearest(line, x);
        if (k < 0) continue;
        const spot = [this.place("x", line.x[k]), this.place("y", line.y[k])];
        if (Math.abs(spot[0] - at) > Math.max(8, 0.02 * width)) continue;
        if (this.holds(...spot)) this.marks.append(make("circle", {cx: spot[0], cy: spot[1], r: 2.6, fill: line.colour}));
        told.push([line.label, line.x[k], line.y[k]]);
      }
      if (!focused && !told.length) return null;
      return told;
    }
    nearest(line, x) {
      let best = -1, least = Infinity;
      for (let k = 0; k < line.x.length; k++) {
        const far = Math.abs(this.inScale("x", line.x[k]) - x);
        if (far < least && Number.isFinite(line.y[k])) [best, least] = [k, far];
      }
      return best;
    }
  }

  const quantity = (label) => /^(.*?)\s*(?:\[([^\]]*)\])?$/.exec(label).slice(1);
  const said = (panel, told) => {
    const [name, unit] = quantity(panel.scales.x.label), [other, own] = quantity(panel.scales.y.label);
    const values = told.map(([label, , y]) => `${label || other}: ${short(y)}${own ? ` ${own}` : ""}`);
    const about = panel.title ? `${panel.title}. ` : "";
    return `${about}${name} ${short(told.length ? told[0][1] : NaN)}${unit ? ` ${unit}` : ""} – ${values.join(", ")}`;
  };

  /* Cells that a spreadsheet would take for a formula are kept as text */
  const cell = (value) => {
    if (typeof value === "number") return Number.isFinite(value) ? String(value) : "";
    const text = /^ *[=+\-@＝＋－＠\t\r]/.test(value) ? `'${value}` : value;
    return /[",\n\r']/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  };
  const table = (told, figure) => {
    if (told.table) {
      const columns = told.table.cells.map((cells) => (Array.isArray(cells) ? cells : decoded(cells)));
      return [told.table.columns, ...(columns[0] || []).map((_, i) => columns.map((column) => column[i]))];
    }
    const rows = [["panel", "curve", "x is", "x", "y is", "y"]];
    for (const panel of figure.panels) {
      for (const line of panel.lines) {
        line.x.forEach((x, k) => rows.push([panel.title, line.label, panel.scales.x.label, x, panel.scales.y.label, line.y[k]]));
      }
    }
    return rows;
  };
  const download = (name, rows) => {
    const text = rows.map((row) => row.map(cell).join(",")).join("\r\n");
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob(["\ufeff", text, "\r\n"], {type: "text/csv"}));
    link.download = `${name}.csv`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  };

  class Figure {
    constructor(element) {
      this.element = element;
      this.told = JSON.parse(element.querySelector("script.numbers").textContent);
      this.drawing = element.querySelector(".drawing");
      this.panels = [];
      this.pictures = [...this.drawing.querySelectorAll(".picture > svg")];
      this.pictures.forEach((svg, i) => {
        for (const told of this.told.pictures[i]) {
          const own = this.told.pictures[i].indexOf(told);
          const panel = new Panel(svg.querySelector(`.panel-${own}`), told);
          panel.svg = svg;
          this.panels.push(panel);
        }
        this.listen(svg);
      });
      this.build();
    }
    build() {
      const bar = document.createElement("div");
      bar.className = "tools";
      this.readout = document.createElement("output");
      this.readout.className = "readout";
      bar.append(this.readout);
      const button = (label, title, action) => {
        const made = document.createElement("button");
        made.type = "button";
        made.textContent = label;
        made.title = title;
        made.addEventListener("click", action);
        bar.append(made);
        return made;
      };
      this.back = button("Whole picture", "Undo the zoom (key 0)", () => this.zoom(0));
      this.back.hidden = true;
      if (this.canZoom) {
        button("+", "Zoom in (key +); or draw a rectangle in the picture", () => this.zoom(0.5)).ariaLabel = "Zoom in";
        button("−", "Zoom out (key −)", () => this.zoom(2)).ariaLabel = "Zoom out";
      }
      button("CSV", "Download this figure's numbers", () => download(this.told.name, table(this.told, this))).ariaLabel =
        "Download this figure's numbers as CSV";
      this.drawing.after(bar);
      this.drawing.tabIndex = 0;
      this.drawing.addEventListener("keydown", (event) => this.key(event));
      this.drawing.addEventListener("blur", () => this.point(null));
    }
    get canZoom() {
      return this.panels.some((panel) => panel.scales.x.kind !== "named" || panel.scales.y.kind !== "named");
    }
    listen(svg) {
      const spot = (event) => {
        const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
        return [point.x, point.y];
      };
      const under = (x, y) => this.panels.find((panel) => panel.svg === svg && panel.holds(x, y));
      let drag = null;
      svg.addEventListener("pointerdown", (event) => {
        const [x, y] = spot(event), panel = under(x, y);
        if (panel && event.pointerType === "mouse" && event.button === 0) {
          drag = {panel, x, y, box: make("rect", {class: "rubber"})};
          panel.group.append(drag.box);
          svg.setPointerCapture(event.pointerId);
          event.preventDefault();
          this.drawing.focus({preventScroll: true});
        }
      });
      svg.addEventListener("pointermove", (event) => {
        const [x, y] = spot(event), panel = under(x, y);
        if (drag) {
          drag.to = this.within(drag.panel, x, y);
          const {x: a, y: b, to} = drag;
          const size = {x: Math.min(a, to[0]), y: Math.min(b, to[1]), width: Math.abs(to[0] - a), height: Math.abs(to[1] - b)};
          for (const [key, value] of Object.entries(size)) drag.box.setAttribute(key, value);
          return;
        }
        this.point(panel ? panel : null, panel ? panel.at("x", x) : null);
      });
      svg.addEventListener("pointerup", () => {
        if (!drag) return;
        const {panel, x, y, to, box} = drag;
        box.remove();
        drag = null;
        if (!to || Math.abs(to[0] - x) < 6 || Math.abs(to[1] - y) < 6) return;
        const sorted = (a, b) => (a < b ? [a, b] : [b, a]);
        const [low, high] = sorted(panel.at("y", y), panel.at("y", to[1]));
        const turned = panel.whole.y[0] > panel.whole.y[1];
        this.see(panel, {x: sorted(panel.at("x", x), panel.at("x", to[0])), y: turned ? [high, low] : [low, high]});
      });
      svg.addEventListener("pointerleave", () => drag || this.point(null));
      svg.addEventListener("dblclick", () => this.zoom(0));
    }
    within(panel, x, y) {
      const [left, top, width, height] = panel.box;
      return [Math.min(Math.max(x, left), left + width), Math.min(Math.max(y, top), top + height)];
    }
    /* Panels below each other with the same abscissa are moved together */
    see(panel, ranges) {
      for (const other of this.panels.filter((one) => one.svg === panel.svg && one !== panel)) {
        const same = other.whole.x.every((end, i) => Math.abs(end - panel.whole.x[i]) < 1e-9 * Math.abs(end || 1));
        if (same && other.scales.x.kind === panel.scales.x.kind) other.see({x: ranges.x});
      }
      panel.see(ranges);
      this.back.hidden = !this.panels.some((one) => one.isZoomed);
    }
    zoom(factor) {
      if (factor === 0) {
        for (const panel of this.panels.filter((one) => one.isZoomed)) panel.see({x: [...panel.whole.x], y: [...panel.whole.y]});
        this.back.hidden = true;
        return;
      }
      const panel = this.current ?? this.panels[0], ranges = {};
      for (const axis of ["x", "y"]) {
        const [low, high] = panel.seen[axis], centre = axis === "x" && this.x !== undefined && this.x !== null ? this.x : (low + high) / 2;
        const half = (factor * (high - low)) / 2, [first, last] = panel.whole[axis];
        let [from, to] = [centre - half, centre + half];
        if (Math.abs(to - from) >= Math.abs(last - first)) [from, to] = [first, last];
        ranges[axis] = [from, to];
      }
      this.see(panel, ranges);
    }
    point(panel, x = null, focused = false) {
      for (const other of this.panels) if (other !== panel) other.point(null);
      this.current = panel ?? this.current;
      this.x = panel ? x : this.x;
      const told = panel ? panel.point(x, focused) : null;
      this.readout.textContent = told ? said(panel, told) : "";
    }
    key(event) {
      const panel = this.current ?? this.panels[0];
      if (!panel || event.ctrlKey || event.altKey || event.metaKey) return;
      const [low, high] = panel.seen.x, step = ((high - low) / 200) * (event.shiftKey ? 10 : 1);
      const now = this.x ?? low, turn = (by) => {
        const next = this.panels[(this.panels.indexOf(panel) + by + this.panels.length) % this.panels.length];
        this.point(next, next.whole.x[0] + ((now - panel.whole.x[0]) / (panel.whole.x[1] - panel.whole.x[0])) * (next.whole.x[1] - next.whole.x[0]), true);
      };
      const actions = {
        ArrowRight: () => this.point(panel, Math.min(now + step, high), true),
        ArrowLeft: () => this.point(panel, Math.max(now - step, low), true),
        ArrowDown: () => turn(1),
        ArrowUp: () => turn(-1),
        "+": () => this.canZoom && this.zoom(0.5),
        "-": () => this.canZoom && this.zoom(2),
        0: () => this.zoom(0),
        Escape: () => this.point(null),
      };
      if (actions[event.key]) {
        actions[event.key]();
        event.preventDefault();
      }
    }
  }

  document.documentElement.classList.add("scripted");
  window.servolensFigures = new Map();
  for (const element of document.querySelectorAll("figure[data-name]")) {
    window.servolensFigures.set(element.dataset.name, new Figure(element));
  }
})();
