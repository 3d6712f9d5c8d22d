// The scene of a compact file as float arrays, and which experts decode which anchors. Lengths are the capture's, positions are relative to
// settings.centre. What the file leaves open is in the settings (files/anchors/live.py).
export const HEADS = ["opacity", "cov", "color"];
const VALUES = { opacity: 1, cov: 7, color: 3 }; // of a Gaussian

// Values [N, C] of a group, C channels of whole numbers.
function floats(channels, steps, classes) {
  const C = channels.length, N = classes.length, out = new Float32Array(N * C), factor = new Float32Array(1);
  for (let c = 0; c < C; ++c) {
    factor[0] = steps[c];
    const step = factor[0], from = channels[c];
    for (let i = 0; i < N; ++i) out[i * C + c] = Math.fround(Math.fround(from[i]) * step) * 2 ** classes[i];
  }
  return out;
}

// A tensor of a network, [E, R, C] in one array; rows have exponents.
function weights(found) {
  if (found.exponents === undefined) return found.values;
  const { values, exponents, shape } = found, C = shape[shape.length - 1], R = exponents.length;
  return Float32Array.from(values, (v, i) => v * 2 ** (exponents[Math.floor(i / C) % R] / 2));
}

const LEAST_MARGIN = 1e-4; // see routers.py

// The weights of chosen experts. gates [E]: the softmax of all logits [E].
function weigh(how, logit, gates, chosen) {
  const rest = Math.max(0, ...gates.filter((_, e) => !chosen.includes(e))), most = Math.max(...chosen.map((e) => logit[e]));
  const found = chosen.map((e) => (how === "margin" ? gates[e] - rest + LEAST_MARGIN : Math.exp(logit[e] - most)));
  const total = found.reduce((a, b) => a + b);
  return found.map((v) => v / total);
}

// The routing of N anchors: experts [N, k] in ascending order and their weights [N, k]. Null where one expert decodes all.
function route(head, router, scene, settings) {
  const { E, k, alone, position, weigh: how } = head;
  if (alone !== null) return null;
  const { N, F, feature, xyz } = scene, { w, b, balance } = router, wide = F + (position ? 3 : 0), { scale, shift } = settings.router;
  const chosen = new Uint16Array(N * k), share = new Float32Array(N * k), logit = new Array(E).fill(0);
  for (let i = 0; i < N; ++i) {
    for (let e = 0; e < E; ++e) {
      let sum = b[e];
      for (let c = 0; c < F; ++c) sum += w[e * wide + c] * feature[i * F + c];
      if (position) for (let a = 0; a < 3; ++a) sum += w[e * wide + F + a] * (xyz[3 * i + a] * scale + shift[a]);
      logit[e] = sum;
    }
    const most = Math.max(...logit), powers = logit.map((v) => Math.exp(v - most)), total = powers.reduce((p, q) => p + q), gates = powers.map((v) => v / total);
    const rank = how === "balanced" ? gates.map((v, e) => v + balance[e]) : logit;
    const order = [...logit.keys()].sort((p, q) => rank[q] - rank[p] || p - q).slice(0, k).sort((p, q) => p - q), found = weigh(how, logit, gates, order);
    for (let j = 0; j < k; ++j) {
      chosen[i * k + j] = order[j];
      share[i * k + j] = found[j];
    }
  }
  return { chosen, share };
}

// A head: its size, its networks (w1 [E, D, H], b1 [E, H], w2 [E, out, H], b2 [E, out]) and its routing.
function makeHead(name, compact, scene, settings) {
  const get = (part) => compact.networks[`${name}.${part}`] ?? compact.exact[`${name}.${part}`];
  const [E, H, wide] = get("experts.w1").shape, how = settings.heads[name], out = VALUES[name] * scene.K;
  const given = weights(get("experts.w1")), b1 = weights(get("experts.b1")).slice();
  const table = name === "color" ? compact.networks["appearance.table"] : undefined, codes = table ? table.shape[1] : 0;
  const D = wide - codes, w1 = new Float32Array(E * D * H), mean = new Float64Array(codes);
  if (table) weights(table).forEach((v, i) => (mean[i % codes] += v / table.shape[0])); // new views have the mean of all codes
  for (let e = 0; e < E; ++e)
    for (let j = 0; j < H; ++j) {
      const from = (e * H + j) * wide;
      for (let d = 0; d < D; ++d) w1[(e * D + d) * H + j] = given[from + d] * (d === scene.F + 3 ? how.distance : 1);
      for (let c = 0; c < codes; ++c) b1[e * H + j] += given[from + D + c] * mean[c];
    }
  const head = { name, E, H, D, out, k: how.k, alone: how.alone, position: how.position, weigh: how.weigh, far: D > scene.F + 3 };
  const router = how.alone === null ? { w: get("router.weight").values, b: get("router.bias").values, balance: get("router_balance")?.values } : null;
  return { ...head, w1, b1, w2: weights(get("experts.w2")), b2: weights(get("experts.b2")), routing: route(head, router, scene, settings) };
}

// The expert of each anchor: the one with the largest weight for its colours, or of the last head that has several.
function strongest(heads) {
  const { k, routing } = heads.findLast((head) => head.routing), out = new Uint8Array(routing.chosen.length / k);
  for (let i = 0; i < out.length; ++i) {
    let best = i * k;
    for (let j = 1; j < k; ++j) if (routing.share[i * k + j] > routing.share[best]) best = i * k + j;
    out[i] = routing.chosen[best];
  }
  return out;
}

// compact: what readCompact returns.
export function makeScene(compact, settings) {
  const { header, groups, cells, lattice } = compact, { N, F, K } = header, classes = groups.class[0], extra = { interval: null, extra_level: null };
  const xyz = new Float32Array(3 * N), level = new Float32Array(N);
  for (let i = 0; i < N; ++i) {
    const [own, edge] = header.lattices[lattice[i]];
    level[i] = own;
    for (let a = 0; a < 3; ++a) xyz[3 * i + a] = cells[3 * i + a] * edge + header.origin[a] - settings.centre[a];
  }
  header.extra.forEach((name, c) => {
    const values = floats([groups.extra[c]], [header.steps.extra[c]], new Int8Array(N));
    extra[name] = name === "interval" ? values.map((v) => Math.exp(Math.min(34, Math.max(-69, v)))) : values;
  });
  const scene = {
    N, F, K, xyz, level, extra, feature: floats(groups.feature, header.steps.feature, classes),
    size: floats(groups.scaling, header.steps.scaling, classes).map(Math.exp), offsets: floats(groups.offsets, header.steps.offsets, classes),
    live: groups.slots ?? null,
  };
  scene.heads = HEADS.map((name) => makeHead(name, compact, scene, settings));
  scene.expert = settings.experts ? strongest(scene.heads) : null;
  return scene;
}

// Anchors in groups that share their experts: perm [64 G] has anchors, NONE where a group ends early; experts [G, k]; share [64 G, k].
export const GROUP = 64, NONE = 0xffffffff;
export function makeGroups(head, N) {
  const { k, routing } = head, alone = head.alone ?? 0, members = new Map();
  for (let i = 0; i < N; ++i) {
    let key = 0;
    if (routing) for (let j = 0; j < k; ++j) key = key * head.E + routing.chosen[i * k + j];
    const list = members.get(key);
    if (list) list.push(i);
    else members.set(key, [i]);
  }
  const lists = [...members.entries()].sort((p, q) => p[0] - q[0]).map((entry) => entry[1]);
  const G = lists.reduce((sum, list) => sum + Math.ceil(list.length / GROUP), 0), width = routing ? k : 1;
  const perm = new Uint32Array(GROUP * G).fill(NONE), experts = new Uint32Array(G * width), share = new Float32Array(GROUP * G * width);
  let g = 0;
  for (const list of lists)
    for (let from = 0; from < list.length; from += GROUP, ++g) {
      for (let j = 0; j < width; ++j) experts[g * width + j] = routing ? routing.chosen[list[0] * k + j] : alone;
      list.slice(from, from + GROUP).forEach((anchor, l) => {
        perm[g * GROUP + l] = anchor;
        for (let j = 0; j < width; ++j) share[(g * GROUP + l) * width + j] = routing ? routing.share[anchor * k + j] : 1;
      });
    }
  return { count: G, width, perm, experts, share };
}
