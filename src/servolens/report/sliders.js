"use strict";
/* Sliders for the gains: the figure of servolens.report.playground, moved by the page's simulator. */
(() => {
  const BUDGET = 6; /* milliseconds of work in a frame, after which no new simulation is begun */
  const PART = 5; /* milliseconds that one simulation may take, where it can be watched for less */
  const JUMP = 0.06; /* as in servolens.report.figures_design */
  const {step, evaluate, horizon, rateOf, settlingTime} = servolensSimulator(servolensRule, servolensPlants);
  const short = (value, digits = 3) => String(Number(value.toPrecision(digits)));

  class Playground {
    constructor(element) {
      this.element = element;
      this.told = JSON.parse(element.querySelector("script.design").textContent);
      this.design = this.told.design;
      this.figure = window.servolensFigures.get(element.dataset.name);
      [this.left, this.right] = this.figure.panels;
      this.frames = [];
      this.isNew = false;
      this.build();
      this.warm();
    }
    build() {
      const form = document.createElement("form"), status = document.createElement("p");
      form.className = "sliders";
      status.className = "told";
      status.setAttribute("role", "status");
      this.inputs = {};
      for (const told of this.told.sliders) {
        const label = document.createElement("label"), name = document.createElement("span");
        const range = document.createElement("input"), exact = document.createElement("input");
        name.textContent = `${told.name} [${told.unit}]`;
        Object.assign(range, {type: "range", min: told.low, max: told.high, step: told.step});
        Object.assign(exact, {type: "number", min: 0, step: "any"});
        exact.setAttribute("aria-label", `${name.textContent}, as a number`);
        const set = (value) => {
          range.value = value;
          exact.value = short(Number(value), 4);
        };
        set(told.value);
        const input = {value: told.value, set: (value) => { input.value = value; set(value); }};
        range.addEventListener("input", () => { input.value = Number(range.value); exact.value = short(input.value, 4); this.change(); });
        exact.addEventListener("input", () => {
          const value = exact.valueAsNumber;
          if (!(Number.isFinite(value) && value >= (told.key === "kp" ? 1e-12 : 0))) return;
          input.value = value;
          range.value = value;
          this.change();
        });
        this.inputs[told.key] = input;
        label.append(name, range, exact);
        form.append(label);
      }
      const again = document.createElement("button");
      again.type = "reset";
      again.textContent = "As at first";
      form.append(again);
      form.addEventListener("reset", (event) => {
        event.preventDefault();
        for (const told of this.told.sliders) this.inputs[told.key].set(told.value);
        this.change();
      });
      form.addEventListener("submit", (event) => event.preventDefault());
      this.status = status;
      this.element.querySelector(".drawing").before(form);
      form.after(status);
      this.mark = document.createElementNS(this.right.svg.namespaceURI, "circle");
      this.mark.setAttribute("class", "now");
      this.mark.setAttribute("r", 4.5);
      this.mark.setAttribute("visibility", "hidden");
      this.right.group.append(this.mark);
    }
    get gains() {
      return {kp: this.inputs.kp.value, free: this.inputs.free.value, integral: this.inputs.integral?.value ?? 0};
    }
    /* The machine's compiler needs a few runs; how long one takes then says how far steps are watched */
    warm() {
      const run = () => {
        const begin = performance.now(), span = this.told.shown * this.design.settling;
        step(this.design, this.told.nominal, this.gains, span);
        this.cost = (performance.now() - begin) / span;
        this.told.scenarios.slice(0, 2).forEach((axis) => step(this.design, axis, this.gains, span));
      };
      let turns = 0;
      const idle = window.requestIdleCallback ?? ((job) => setTimeout(job, 30));
      const again = () => {
        run();
        if (++turns < 6) return idle(again);
        this.isWarm = true;
        this.show();
      };
      idle(again);
    }
    /* All of a frame's work is here: the gains first, then as much of the rest as there is time for */
    change() {
      this.isNew = true;
      if (this.isRunning) return;
      this.isRunning = true;
      const frame = () => {
        const begin = performance.now();
        let done = false;
        if (this.isNew) {
          this.isNew = false;
          this.show();
          this.jobs = this.slices();
        }
        while (!done && performance.now() - begin < BUDGET) done = this.jobs.next().done;
        this.frames.push(performance.now() - begin);
        this.isRunning = !done;
        if (!done) requestAnimationFrame(frame);
      };
      requestAnimationFrame(frame);
    }
    /* The step with these gains, at once */
    show() {
      const design = this.design, gains = this.gains, axis = this.told.nominal;
      const whole = horizon(design, axis, gains), shown = this.told.shown * design.settling;
      const watched = Math.max(Math.min(whole, PART / Math.max(this.cost ?? 0, 1e-9)), shown);
      const found = evaluate(design, axis, gains, watched);
      this.found = found;
      this.draw(this.left, "live-step-velocity", this.path(this.left, found.run.n, (k) => found.run.time[k], (k) => found.run.position[k]));
      this.remember();
      const designed = this.told.sliders.every((told) => told.key === "free" || this.inputs[told.key].value === told.value);
      for (const part of this.right.group.querySelectorAll(".live-designed")) part.style.display = designed ? "" : "none";
      const at = found.settling === null ? this.right.whole.y[1] : found.settling;
      this.mark.setAttribute("cx", this.right.place("x", gains.free));
      this.mark.setAttribute("cy", this.right.place("y", at));
      this.mark.setAttribute("visibility", "visible");
      this.mark.classList.toggle("late", !found.meets);
      this.say(found, gains);
    }
    say(found, gains, axes = null) {
      const names = this.told.sliders.map((told) => `${told.name} = ${short(this.inputs[told.key].value, 4)} ${told.unit}`);
      const settles = found.stable
        ? found.settling === null ? "does not settle" : `settles in ${short(found.settling)} s`
        : "is unstable";
      const more = found.stable
        ? `, overshoots by ${short(100 * found.overshoot)} % and asks for ${short(found.peak)} ${this.told.commandUnit}`
        : "";
      const spread = axes === null ? "" : ` ${axes[0]} of ${axes[1]} axes as they may be meet what is asked for.`;
      this.status.textContent = `With ${names.join(", ")} the step ${settles}${more}: ${found.meets ? "it meets" : "it misses"} the target.${spread}`;
    }
    /* What takes longer, in parts */
    *slices() {
      const design = this.design, gains = this.gains, found = this.found;
      yield* this.stepSpread(design, gains, found);
      const told = JSON.stringify([gains.kp, gains.integral]);
      if (told !== this.drawnFor) {
        yield* this.settlingCurve(design, gains);
        yield* this.settlingSpread(design, gains);
        this.drawnFor = told;
      }
    }
    *stepSpread(design, gains, found) {
      const count = this.told.times, end = this.told.shown * design.settling;
      const low = new Float64Array(count).fill(Infinity), high = new Float64Array(count).fill(-Infinity);
      let meet = 0;
      for (const axis of this.told.scenarios) {
        const own = evaluate(design, axis, gains, Math.max(Math.min(horizon(design, axis, gains), PART / this.cost), end)), run = own.run;
        meet += own.meets;
        for (let i = 0; i < count; i++) {
          const place = (end * i) / (count - 1) / design.sample, k = Math.min(Math.floor(place), run.n - 2);
          if (k < 0 || (!run.whole && place > run.n - 1)) continue;
          const value = run.position[k] + (place - k) * (run.position[k + 1] - run.position[k]);
          const seen = axis.back ? design.reference - value : value;
          low[i] = Math.min(low[i], seen);
          high[i] = Math.max(high[i], seen);
        }
        yield;
      }
      const time = Array.from(low, (_, i) => (end * i) / (count - 1));
      this.drawBand(this.left, "live-step-spread", time, low, high);
      this.say(found, gains, [meet, this.told.scenarios.length]);
      yield;
    }
    *settlingCurve(design, gains) {
      const axis = this.told.nominal, [low, high, count] = this.told.gains, times = [], places = [];
      const swing = (2 * Math.PI) / Math.max(rateOf(design, axis, gains), 1e-6);
      const watched = Math.max(this.told.settledWithin * design.settling, 2 * swing);
      for (let i = 0; i < count; i++) {
        const free = low + ((high - low) * i) / (count - 1), time = this.settles(design, axis, {...gains, free}, watched);
        if (i && Math.abs(time - times.at(-1)) > JUMP * swing) {
          places.push(NaN);
          times.push(NaN);
        }
        places.push(free);
        times.push(time);
        yield;
      }
      this.draw(this.right, "live-settling-velocity", this.path(this.right, times.length, (k) => places[k], (k) => times[k]));
      const line = this.right.lines[0];
      [line.x, line.y] = [places, times];
      yield;
    }
    *settlingSpread(design, gains) {
      const [low, high, , count] = this.told.gains, top = this.right.whole.y[1];
      const watched = Math.min(1.02 * top, this.told.settledWithin * design.settling), places = [], first = [], last = [];
      for (let i = 0; i < count; i++) {
        const free = low + ((high - low) * i) / (count - 1);
        let least = Infinity, most = -Infinity;
        for (const axis of this.told.scenarios) {
          const time = this.settles(design, axis, {...gains, free}, watched), known = Number.isFinite(time) ? time : top;
          least = Math.min(least, known);
          most = Math.max(most, known);
          yield;
        }
        places.push(free);
        first.push(least);
        last.push(most);
      }
      this.drawBand(this.right, "live-settling-spread", places, first, last);
    }
    settles(design, axis, gains, watched) {
      const run = step(design, axis, gains, watched);
      if (!run.whole) return NaN;
      const end = axis.back ? 0 : design.reference, size = axis.back ? -design.reference : design.reference;
      return settlingTime(run, (k) => (end - run.position[k]) / size, design.band) ?? NaN;
    }
    /* Paths are in the picture's own units, before any zoom */
    spot(panel, x, y) {
      const [left, top, width, height] = panel.box, {x: [a, b], y: [c, d]} = panel.whole;
      return [left + ((x - a) / (b - a)) * width, top + (1 - (y - c) / (d - c)) * height];
    }
    path(panel, count, x, y) {
      const parts = [], end = panel.whole.x[1];
      let pen = "M";
      for (let k = 0; k < count && !(x(k) > end); k++) {
        if (!Number.isFinite(y(k))) {
          pen = "M";
          continue;
        }
        const [a, b] = this.spot(panel, x(k), y(k));
        parts.push(`${pen}${a.toFixed(2)} ${Math.min(Math.max(b, -1e4), 1e4).toFixed(2)}`);
        pen = "L";
      }
      return parts.join("");
    }
    draw(panel, name, d) {
      panel.group.querySelector(`.${name} path`)?.setAttribute("d", d || "M0 0");
    }
    drawBand(panel, name, x, low, high) {
      const there = [...x.keys()].filter((k) => Number.isFinite(low[k]) && Number.isFinite(high[k]));
      const upper = there.map((k) => this.spot(panel, x[k], high[k])), lower = there.reverse().map((k) => this.spot(panel, x[k], low[k]));
      const d = `M${[...upper, ...lower].map(([a, b]) => `${a.toFixed(2)} ${Math.min(Math.max(b, -1e4), 1e4).toFixed(2)}`).join("L")}Z`;
      const group = panel.group.querySelector(`.${name}`);
      if (!group || !there.length) return;
      let own = group.querySelector("path.band");
      if (!own) {
        const use = group.querySelector("use"), clip = group.querySelector("[clip-path]") ?? group.closest("[clip-path]");
        own = document.createElementNS(this.right.svg.namespaceURI, "path");
        own.setAttribute("class", "band");
        own.setAttribute("style", use.getAttribute("style"));
        (clip && group.contains(clip) ? clip : group).append(own);
        use.remove();
      }
      own.setAttribute("d", d);
    }
    /* The cursor reads what is drawn */
    remember() {
      const line = this.left.lines[0], run = this.found.run;
      const stride = Math.max(Math.floor((this.told.shown * this.design.settling) / this.design.sample / 600), 1);
      line.x = [];
      line.y = [];
      for (let k = 0; k < run.n && run.time[k] <= this.left.whole.x[1]; k += stride) {
        line.x.push(run.time[k]);
        line.y.push(run.position[k]);
      }
    }
  }

  window.servolensPlaygrounds = [...document.querySelectorAll("figure.playground")].map((element) => new Playground(element));
})();
