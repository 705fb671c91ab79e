"""JAX's side: jax_peer.py WORKLOAD jit, with WORKLOAD iql | score-train | score-eval-N."""
import os
import sys

os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import common as c  # noqa: E402

rng = np.random.default_rng(0)


def layers(*widths):
    bound = lambda i, *shape: jnp.asarray(rng.uniform(-(i**-0.5), i**-0.5, shape), jnp.float32)  # noqa: E731
    return [(bound(i, i, o), bound(i, o)) for i, o in zip(widths, widths[1:])]


def mlp(net, x, act=jax.nn.relu, last=lambda y: y):
    for w, b in net[:-1]:
        x = act(x @ w + b)
    w, b = net[-1]
    return last(x @ w + b)


def adam(net, grads, moments, time, lr=c.LR):
    m = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, moments[0], grads)
    v = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g * g, moments[1], grads)
    new = lambda x, m, v: x - lr / (1 - 0.9**time) * m / (jnp.sqrt(v / (1 - 0.999**time)) + 1e-8)  # noqa: E731
    return jax.tree.map(new, net, m, v), (m, v)


def zeros(net):
    return jax.tree.map(jnp.zeros_like, net), jax.tree.map(jnp.zeros_like, net)


def follow(slow, fast, rate):
    return jax.tree.map(lambda s, f: s + rate * (f - s), slow, fast)


def iql():
    normal = lambda *shape: jnp.asarray(rng.standard_normal(shape), jnp.float32)  # noqa: E731
    data = (normal(c.ROWS, c.OBS), jnp.tanh(normal(c.ROWS, c.ACT)), normal(c.ROWS, 1), normal(c.ROWS, c.OBS),
            jnp.asarray(rng.random((c.ROWS, 1)) > 0.01, jnp.float32))
    v, pi = layers(c.OBS, c.WIDTH, c.WIDTH, 1), layers(c.OBS, c.WIDTH, c.WIDTH, c.ACT)
    q = [layers(c.OBS + c.ACT, c.WIDTH, c.WIDTH, 1) for _ in range(2)]
    nets = {"v": v, "q": q, "pi": pi}
    state = {"nets": nets, "moments": {k: zeros(n) for k, n in nets.items()}, "target": jax.tree.map(jnp.copy, q), "t": jnp.float32(0)}

    def update(state, data, rows):
        s, a, r, s2, alive = (x[rows] for x in data)
        sa, t, nets, moments = jnp.concatenate([s, a], 1), state["t"] + 1, dict(state["nets"]), dict(state["moments"])
        target = jnp.minimum(*(mlp(q, sa) for q in state["target"]))

        def v_loss(v):
            u = target - mlp(v, s)
            return jnp.mean(jnp.abs(c.EXPECTILE - (u < 0)) * u**2), u
        grads, u = jax.grad(v_loss, has_aux=True)(nets["v"])
        nets["v"], moments["v"] = adam(nets["v"], grads, moments["v"], t)
        y = r + alive * c.GAMMA * mlp(nets["v"], s2)
        grads = jax.grad(lambda qs: sum(jnp.mean((mlp(q, sa) - y) ** 2) for q in qs))(nets["q"])
        nets["q"], moments["q"] = adam(nets["q"], grads, moments["q"], t)
        w = jnp.minimum(jnp.exp(c.BETA * u), c.CAP)
        grads = jax.grad(lambda pi: jnp.mean(w * (jnp.tanh(mlp(pi, s)) - a) ** 2))(nets["pi"])
        nets["pi"], moments["pi"] = adam(nets["pi"], grads, moments["pi"], t)
        return {"nets": nets, "moments": moments, "target": follow(state["target"], nets["q"], c.POLYAK), "t": t}
    update = jax.jit(update, donate_argnums=0)
    box = [state]

    def step():
        box[0] = update(box[0], data, rng.integers(0, c.ROWS, c.BATCH))
        jax.block_until_ready(box[0]["t"])
    return step


def score_net():
    e, h = c.EMBEDDING, c.WIDTH
    return {"time": layers(1, e, e), "label": layers(1, e, e), "input": layers(c.OBS + 2 * e, h),
            "blocks": [layers(h, h)[0] for _ in range(c.BLOCKS)], "output": layers(h, c.OBS)}


def score(net, x, time, label):
    silu = jax.nn.silu
    h = mlp(net["input"], jnp.concatenate([x, mlp(net["time"], time, silu, silu), mlp(net["label"], label, silu, silu)], 1))
    for w, b in net["blocks"]:
        h = h + silu(h @ w + b)
    return mlp(net["output"], h)


def score_train():
    net = score_net()
    data = jnp.asarray(rng.standard_normal((c.ROWS, c.OBS)), jnp.float32)
    labels = jnp.asarray(rng.integers(0, 2, (c.ROWS, 1)), jnp.float32)

    def update(state, pick, sigma, z):
        net, moments, average, t = state
        x, y, scale = data[pick], labels[pick], 1 / jnp.sqrt(sigma**2 + 1)
        target = (x - scale**2 * (x + sigma * z)) / (sigma * scale)
        grads = jax.grad(lambda n: jnp.mean((score(n, scale * (x + sigma * z), jnp.log(sigma) / 4, y) - target) ** 2))(net)
        net, moments = adam(net, grads, moments, t + 1, 5e-4)
        return net, moments, follow(average, net, 1e-3), t + 1
    update = jax.jit(update, donate_argnums=0)
    box = [(net, zeros(net), jax.tree.map(jnp.copy, net), jnp.float32(0))]

    def step():
        sigma = np.exp(1.2 * rng.standard_normal((c.SCORE_BATCH, 1)) - 1.2).astype(np.float32)
        z = rng.standard_normal((c.SCORE_BATCH, c.OBS)).astype(np.float32)
        box[0] = update(box[0], rng.integers(0, c.ROWS, c.SCORE_BATCH), sigma, z)
        jax.block_until_ready(box[0][3])
    return step


def score_eval(rows):
    f, net, x = jax.jit(score), score_net(), jnp.asarray(rng.standard_normal((rows, c.OBS)), jnp.float32)
    time, label = jnp.full((rows, 1), 0.3), jnp.asarray(rng.random((rows, 1)), jnp.float32)
    return lambda: jax.block_until_ready(f(net, x, time, label))


workload = sys.argv[1]
if workload == "iql":
    c.serve(iql(), warm_up=20)
elif workload == "score-train":
    c.serve(score_train(), warm_up=20)
else:
    n = {"1k": 1024, "4k": 4096, "16k": 16384}[workload.removeprefix("score-eval-")]
    c.serve(score_eval(n), units=n)
