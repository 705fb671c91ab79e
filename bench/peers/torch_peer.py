"""PyTorch's side: torch_peer.py WORKLOAD VARIANT, with WORKLOAD iql | sac | score-train | score-eval-N and VARIANT eager | compile
(what people run) | whole (iql: the whole step with twins as one batched product, gradients and Adam in one compiled graph) |
hoisted, hoisted-compile (score-eval: label and time passed through their layers beforehand, as a sampler may)."""
import copy
import sys

import torch
import torch.nn.functional as F
from torch import nn

import common as c

torch.set_num_threads(1)
torch.manual_seed(0)


def mlp(*widths, act=nn.ReLU):
    layers = []
    for i, (a, b) in enumerate(zip(widths, widths[1:])):
        layers += [nn.Linear(a, b)] + ([act()] if i + 2 < len(widths) else [])
    return nn.Sequential(*layers)


def table():
    s, a = torch.randn(c.ROWS, c.OBS), torch.tanh(torch.randn(c.ROWS, c.ACT))
    return s, a, torch.randn(c.ROWS, 1), torch.randn(c.ROWS, c.OBS), (torch.rand(c.ROWS, 1) > 0.01).float()


class Iql:
    """As the field's single-file implementations write it."""

    def __init__(self, compiled):
        self.v, self.pi = mlp(c.OBS, c.WIDTH, c.WIDTH, 1), mlp(c.OBS, c.WIDTH, c.WIDTH, c.ACT)
        self.q1, self.q2 = (mlp(c.OBS + c.ACT, c.WIDTH, c.WIDTH, 1) for _ in range(2))
        self.t1, self.t2 = copy.deepcopy(self.q1), copy.deepcopy(self.q2)
        adam = lambda *nets: torch.optim.Adam([p for n in nets for p in n.parameters()], lr=c.LR, fused=compiled or None)  # noqa: E731
        self.v_adam, self.q_adam, self.pi_adam = adam(self.v), adam(self.q1, self.q2), adam(self.pi)
        self.table = table()
        wrap = torch.compile if compiled else (lambda f: f)
        self.v_loss, self.q_loss, self.pi_loss = wrap(self._v_loss), wrap(self._q_loss), wrap(self._pi_loss)

    def _v_loss(self, s, sa):
        with torch.no_grad():
            q = torch.min(self.t1(sa), self.t2(sa))
        u = q - self.v(s)
        return (torch.abs(c.EXPECTILE - (u < 0).float()) * u**2).mean(), u.detach()

    def _q_loss(self, sa, r, s2, alive):
        with torch.no_grad():
            y = r + alive * c.GAMMA * self.v(s2)
        return F.mse_loss(self.q1(sa), y) + F.mse_loss(self.q2(sa), y)

    def _pi_loss(self, s, a, u):
        w = torch.exp(c.BETA * u).clamp(max=c.CAP)
        return (w * (torch.tanh(self.pi(s)) - a) ** 2).mean()

    def step(self):
        rows = torch.randint(0, c.ROWS, (c.BATCH,))
        s, a, r, s2, alive = (x[rows] for x in self.table)
        sa = torch.cat([s, a], 1)
        loss, u = self.v_loss(s, sa)
        self.descend(self.v_adam, loss)
        self.descend(self.q_adam, self.q_loss(sa, r, s2, alive))
        with torch.no_grad():
            for q, t in ((self.q1, self.t1), (self.q2, self.t2)):
                for p, tp in zip(q.parameters(), t.parameters()):
                    tp.lerp_(p, c.POLYAK)
        self.descend(self.pi_adam, self.pi_loss(s, a, u))

    @staticmethod
    def descend(adam, loss):
        adam.zero_grad(set_to_none=True)
        loss.backward()
        adam.step()


class Sac:
    """As the field's single-file implementations write it: twins apart, automatic temperature, one policy update per update."""

    def __init__(self, compiled):
        self.pi = mlp(c.OBS, c.WIDTH, c.WIDTH, 2 * c.ACT)
        self.q1, self.q2 = (mlp(c.OBS + c.ACT, c.WIDTH, c.WIDTH, 1) for _ in range(2))
        self.t1, self.t2 = copy.deepcopy(self.q1), copy.deepcopy(self.q2)
        self.log_alpha = torch.zeros(1, requires_grad=True)
        adam = lambda parameters: torch.optim.Adam(parameters, lr=c.LR, fused=compiled or None)  # noqa: E731
        self.q_adam = adam([*self.q1.parameters(), *self.q2.parameters()])
        self.pi_adam, self.alpha_adam = adam(self.pi.parameters()), adam([self.log_alpha])
        self.table = table()
        wrap = torch.compile if compiled else (lambda f: f)
        self.q_loss, self.pi_loss = wrap(self._q_loss), wrap(self._pi_loss)

    def sample(self, s):
        mean, log_std = self.pi(s).chunk(2, -1)
        log_std = log_std.clamp(-20, 2)
        noise = torch.randn_like(mean)
        u = mean + log_std.exp() * noise
        normal = -0.5 * noise**2 - log_std - 0.9189385332046727
        return torch.tanh(u), (normal - 2 * (0.6931471805599453 - u - F.softplus(-2 * u))).sum(1, keepdim=True)

    def _q_loss(self, s, a, r, s2, alive, alpha):
        with torch.no_grad():
            a2, log_prob = self.sample(s2)
            sa2 = torch.cat([s2, a2], 1)
            y = r + alive * c.GAMMA * (torch.min(self.t1(sa2), self.t2(sa2)) - alpha * log_prob)
        sa = torch.cat([s, a], 1)
        return F.mse_loss(self.q1(sa), y) + F.mse_loss(self.q2(sa), y)

    def _pi_loss(self, s, alpha):
        a, log_prob = self.sample(s)
        sa = torch.cat([s, a], 1)
        return (alpha * log_prob - torch.min(self.q1(sa), self.q2(sa))).mean(), log_prob.detach()

    def step(self):
        rows = torch.randint(0, c.ROWS, (c.BATCH,))
        s, a, r, s2, alive = (x[rows] for x in self.table)
        alpha = self.log_alpha.detach().exp()
        Iql.descend(self.q_adam, self.q_loss(s, a, r, s2, alive, alpha))
        for q in (self.q1, self.q2):
            q.requires_grad_(False)
        loss, log_prob = self.pi_loss(s, alpha)
        Iql.descend(self.pi_adam, loss)
        for q in (self.q1, self.q2):
            q.requires_grad_(True)
        Iql.descend(self.alpha_adam, -(self.log_alpha * (log_prob - c.ACT).mean()).sum())
        with torch.no_grad():
            for q, t in ((self.q1, self.t1), (self.q2, self.t2)):
                for p, tp in zip(q.parameters(), t.parameters()):
                    tp.lerp_(p, c.POLYAK)


class WholeIql:
    """Everything after the choice of rows in one graph."""

    def __init__(self):
        def stack(n, *widths):
            out = []
            for i, o in zip(widths, widths[1:]):
                k = i**-0.5
                out += [torch.empty(n, i, o).uniform_(-k, k), torch.empty(n, 1, o).uniform_(-k, k)]
            return out
        self.v, self.pi = stack(1, c.OBS, c.WIDTH, c.WIDTH, 1), stack(1, c.OBS, c.WIDTH, c.WIDTH, c.ACT)
        self.q = stack(2, c.OBS + c.ACT, c.WIDTH, c.WIDTH, 1)
        self.target = [x.clone() for x in self.q]
        moments = lambda net: ([torch.zeros_like(x) for x in net], [torch.zeros_like(x) for x in net])  # noqa: E731
        self.moments = [moments(net) for net in (self.v, self.q, self.pi)]
        self.table, self.time = table(), torch.zeros((), dtype=torch.float64)
        self.graph = torch.compile(self.update, fullgraph=True)

    @staticmethod
    def forward(w, x):
        h = torch.relu(torch.baddbmm(w[1], x, w[0]))
        h = torch.relu(torch.baddbmm(w[3], h, w[2]))
        return torch.baddbmm(w[5], h, w[4])

    @staticmethod
    def adam(net, grads, moments, time):
        for x, g, m, v in zip(net, grads, *moments):
            m.copy_(0.9 * m + 0.1 * g)
            v.copy_(0.999 * v + 0.001 * g * g)
            x.sub_(c.LR / (1 - 0.9**time) * m / ((v / (1 - 0.999**time)).sqrt() + 1e-8))

    def update(self, rows, time):
        s, a, r, s2, alive = (x[rows][None] for x in self.table)
        sa = torch.cat([s, a], -1).expand(2, -1, -1)
        target = self.forward(self.target, sa).amin(0, keepdim=True)

        def v_loss(v):
            u = target - self.forward(v, s)
            return (torch.abs(c.EXPECTILE - (u < 0).float()) * u**2).mean(), u
        grads, u = torch.func.grad(v_loss, has_aux=True)(self.v)
        self.adam(self.v, grads, self.moments[0], time)
        y = r + alive * c.GAMMA * self.forward(self.v, s2)
        grads = torch.func.grad(lambda q: ((self.forward(q, sa) - y) ** 2).mean((1, 2)).sum())(self.q)
        self.adam(self.q, grads, self.moments[1], time)
        for t, q in zip(self.target, self.q):
            t.lerp_(q, c.POLYAK)
        w = torch.exp(c.BETA * u).clamp(max=c.CAP)
        grads = torch.func.grad(lambda pi: (w * (torch.tanh(self.forward(pi, s)) - a) ** 2).mean())(self.pi)
        self.adam(self.pi, grads, self.moments[2], time)

    def step(self):
        self.time += 1
        self.graph(torch.randint(0, c.ROWS, (c.BATCH,)), self.time)


class Score(nn.Module):
    """Tables B.1 and B.2."""

    def __init__(self):
        super().__init__()
        embed = lambda: nn.Sequential(nn.Linear(1, c.EMBEDDING), nn.SiLU(), nn.Linear(c.EMBEDDING, c.EMBEDDING), nn.SiLU())  # noqa: E731
        self.time, self.label = embed(), embed()
        self.input = nn.Linear(c.OBS + 2 * c.EMBEDDING, c.WIDTH)
        self.blocks = nn.ModuleList(nn.Linear(c.WIDTH, c.WIDTH) for _ in range(c.BLOCKS))
        self.output = nn.Linear(c.WIDTH, c.OBS)

    def trunk(self, h):
        for block in self.blocks:
            h = h + F.silu(block(h))
        return self.output(h)

    def forward(self, x, time, label):
        return self.trunk(self.input(torch.cat([x, self.time(time), self.label(label)], 1)))


class Hoisted(nn.Module):
    def __init__(self, net, label):
        super().__init__()
        self.net = net
        x, time, y = net.input.weight.split([c.OBS, c.EMBEDDING, c.EMBEDDING], 1)
        self.x, self.t = x.contiguous(), time.contiguous()
        self.label = F.linear(net.label(label), y.contiguous(), net.input.bias)

    def forward(self, x, time, _):
        return self.net.trunk(F.linear(x, self.x) + self.label + F.linear(self.net.time(time[:1]), self.t))


def score_train(compiled):
    net, rows, labels = Score(), torch.randn(c.ROWS, c.OBS), torch.randint(0, 2, (c.ROWS, 1)).float()
    average, adam = copy.deepcopy(net), torch.optim.Adam(net.parameters(), lr=5e-4, fused=compiled or None)

    def loss(x, y, sigma, z):
        scale = 1 / (sigma**2 + 1).sqrt()
        target = (x - scale**2 * (x + sigma * z)) / (sigma * scale)
        return F.mse_loss(net(scale * (x + sigma * z), sigma.log() / 4, y), target)
    loss = torch.compile(loss) if compiled else loss

    def step():
        pick = torch.randint(0, c.ROWS, (c.SCORE_BATCH,))
        sigma, z = torch.exp(1.2 * torch.randn(c.SCORE_BATCH, 1) - 1.2), torch.randn(c.SCORE_BATCH, c.OBS)
        value = loss(rows[pick], labels[pick], sigma, z)
        adam.zero_grad(set_to_none=True)
        value.backward()
        adam.step()
        with torch.no_grad():
            if compiled:
                torch._foreach_lerp_(list(average.parameters()), list(net.parameters()), 1e-3)
            else:
                for a, p in zip(average.parameters(), net.parameters()):
                    a.lerp_(p, 1e-3)
    return step


def score_eval(rows, variant):
    net, x, time, label = Score().eval(), torch.randn(rows, c.OBS), torch.full((rows, 1), 0.3), torch.rand(rows, 1)
    with torch.no_grad():
        f = Hoisted(net, label) if "hoisted" in variant else net
        f = torch.compile(f) if "compile" in variant else f
        f(x, time, label)

    def call():
        with torch.no_grad():
            f(x, time, label)
    return call


def main(workload, variant):
    compiled = "compile" in variant
    if workload == "sac":
        c.serve(Sac(compiled).step, warm_up=20)
    elif workload == "iql":
        c.serve((WholeIql() if variant == "whole" else Iql(compiled)).step, warm_up=20)
    elif workload == "score-train":
        c.serve(score_train(compiled), warm_up=20)
    else:
        rows = {"1k": 1024, "4k": 4096, "16k": 16384}[workload.removeprefix("score-eval-")]
        c.serve(score_eval(rows, variant), units=rows)


main(*sys.argv[1:3])
