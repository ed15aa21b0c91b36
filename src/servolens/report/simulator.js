"use strict";
/* The page's simulator: what servolensRule does of a plant, in the loop that a design asks for.

   `design` is the object that servolens.report.playground writes; `gains` are {kp, free, integral}. Everything here is
   the counterpart of a Python function, named at its side; the tests hold both against each other. */
const servolensSimulator = (rule, plants) => {
  const compiled = new Map();

  const runnerOf = (name) => {
    if (!compiled.has(name)) compiled.set(name, rule(plants[name]));
    return compiled.get(name);
  };

  /* servolens.simulation.settings, for the controller that PDSpec.loop makes of the gains */
  const loopOf = (design, axis, gains) => {
    const realised = axis.realised;
    const place = design.places, loop = Float64Array.from(design.loop, (value) => (value === null ? Infinity : value));
    const free = realised * gains.free, integral = realised * gains.integral;
    const isCascade = design.law === "cascade", idle = isCascade && free === 0;
    loop[place.KP] = idle ? 0 : isCascade ? free * gains.kp : realised * gains.kp;
    loop[place.KD] = free;
    loop[place.KI] = isCascade ? 0 : integral;
    loop[place.INTEGRAL_RATE] = isCascade && !idle ? integral / free : 0;
    const integrates = loop[place.KI] !== 0 || loop[place.INTEGRAL_RATE] !== 0;
    loop[place.IS_PD] = !integrates && (loop[place.WEIGHT] === 1 || idle) ? 1 : 0;
    loop[place.CLAMPS] = integrates && design.antiWindup === "clamping" ? 1 : 0;
    loop[place.PULL] = 0;
    loop[place.LIMIT] = axis.limit === null ? Infinity : axis.limit;
    if (integrates && design.antiWindup === "back_calculation") {
      const ki = loop[place.KI], kd = loop[place.KD];
      const tracking = ki === 0 ? 1 / loop[place.INTEGRAL_RATE] : kd === 0 ? loop[place.KP] / ki : Math.sqrt(kd / ki);
      loop[place.PULL] = 1 / tracking;
    }
    return loop;
  };

  /* servolens.simulation.rates.substeps_for */
  const substepsOf = (design, axis, gains) => {
    const realised = axis.realised;
    if (!design.continuous) return axis.substeps;
    const extra = Math.sqrt(Math.abs(axis.gain * realised * gains.kp)) + Math.abs(axis.gain * realised * gains.free);
    const span = design.sample * (axis.rate + extra), rules = design.substeps;
    const fine = Math.ceil(span / axis.fine - rules.rounding), coarse = Math.ceil(span / rules.coarse - rules.rounding);
    return Math.min(Math.max(Math.min(fine, rules.few), coarse, axis.least), rules.most);
  };

  /* servolens.design.rest.rest_of: where the axis rests; what is applied, and the integral, are written into the loop */
  const rest = (design, axis, loop, reference) => {
    if (axis.held === null) return reference;
    const place = design.places, [held, slope] = axis.held;
    const kp = loop[place.KP], ahead = kp * (loop[place.WEIGHT] - 1) * reference;
    if (loop[place.KI] !== 0 || loop[place.INTEGRAL_RATE] !== 0) {
      loop[place.BEFORE] = held;
      loop[place.INTEGRAL_BEFORE] = held - ahead;
      return reference;
    }
    if (!(kp > 0)) return reference;
    const away = (ahead - held) / (kp + slope);
    loop[place.BEFORE] = ahead - kp * away;
    return reference + away;
  };

  /* servolens.design.settle.step_response; a loop that leaves all bounds has fewer samples than asked for */
  const step = (design, axis, gains, duration) => {
    const n = Math.ceil(duration / design.sample) + 1, realised = axis.realised;
    const begin = axis.back ? design.reference : 0, end = axis.back ? 0 : design.reference;
    const time = Float64Array.from({length: n}, (_, k) => design.sample * k);
    const reference = new Float64Array(n).fill(end);
    const held = design.continuous ? reference : new Float64Array(n);
    const own = design.continuous ? [realised * gains.kp, realised * gains.free] : [];
    const values = Float64Array.from([...axis.values, ...own]), loop = loopOf(design, axis, gains);
    const start = Float64Array.from([rest(design, axis, loop, begin), 0, 0]);
    if (design.continuous) for (const name of ["KP", "KD", "IS_PD"]) loop[design.places[name]] = +(name === "IS_PD");
    if (design.continuous) loop[design.places.BEFORE] = begin;
    const results = new Float64Array(3 * n), measured = new Float64Array(n), none = new Float64Array(3);
    const count = substepsOf(design, axis, gains);
    const done = runnerOf(axis.plant)(
      n, count, axis.delay, time, held, reference, loop, start, values, none, results, measured
    );
    const voltage = results.subarray(2 * n);
    if (design.continuous) {
      for (let k = 0; k < done; k++) voltage[k] = own[0] * (end - measured[k]) - own[1] * results[n + k];
    }
    return {n: done, whole: done === n, time, position: results.subarray(0, n), voltage};
  };

  /* servolens.design.settle.settling_time, of the share of the step that is left; null where it does not settle */
  const settlingTime = (run, left, band) => {
    let last = run.n - 1;
    while (last >= 0 && !(Math.abs(left(last)) > band)) last--;
    if (last < 0) return 0;
    if (last + 1 === run.n) return null;
    const here = left(last), share = (here - band * Math.sign(here)) / (here - left(last + 1));
    return run.time[last] + share * (run.time[last + 1] - run.time[last]);
  };

  /* servolens.design.settle.evaluate */
  const evaluate = (design, axis, gains, duration) => {
    const run = step(design, axis, gains, duration), limit = design.limit;
    if (!run.whole) return {run, settling: null, overshoot: Infinity, peak: Infinity, stable: false, meets: false};
    const size = axis.back ? -design.reference : design.reference, end = axis.back ? 0 : design.reference;
    const left = (k) => (end - run.position[k]) / size;
    let overshoot = 0, peak = 0;
    for (let k = 0; k < run.n; k++) {
      overshoot = Math.max(overshoot, -left(k));
      peak = Math.max(peak, Math.abs(run.voltage[k]));
    }
    const settling = settlingTime(run, left, design.band + design.feasible);
    const meets = settling !== null && settling <= design.settling * (1 + 1e-9)
      && (design.overshoot === null || overshoot <= design.overshoot + design.feasible)
      && (limit === null || peak <= axis.realised * limit * (1 + design.feasible));
    return {run, settling, overshoot, peak, stable: true, meets};
  };

  const rateOf = (design, axis, gains) =>
    design.law === "cascade" ? gains.kp : Math.sqrt(Math.abs(axis.gain) * gains.kp * axis.realised);

  /* servolens.design.settle.horizon */
  const horizon = (design, axis, gains) => {
    const period = (2 * Math.PI) / Math.max(rateOf(design, axis, gains), 1e-6);
    return design.settling * Math.max(10, 1 + Math.min((3 * period) / design.settling, 20));
  };

  return {step, evaluate, horizon, rateOf, settlingTime};
};
