use std::time::Instant;
use tce_base::Streams;
use tce_nn::{AdamConfig, Device, MlpConfig, Module, tensor};
fn main() {
    let p: usize = std::env::args().nth(1).map_or(1, |a| a.parse().unwrap());
    let n = 200;
    let device = Device::flex().autodiff();
    let members: Vec<_> = (0..p as u64).map(Streams::new).collect();
    let mut net = MlpConfig::relu(17, &[256, 256], 1).init(&members, "v", &device);
    let mut adam = AdamConfig::default().init();
    let x = tensor((0..p * 256 * 17).map(|i| (i as f32 * 0.37).sin()).collect(), [p, 256, 17], &device);
    for phase in ["warm", "train", "train"] {
        let t = Instant::now();
        let (mut f, mut b, mut a) = (0.0, 0.0, 0.0);
        for _ in 0..n {
            let t0 = Instant::now();
            let loss = net.forward(x.clone()).square().mean();
            f += t0.elapsed().as_secs_f64();
            let t0 = Instant::now();
            let mut g = loss.backward();
            drop(loss);
            b += t0.elapsed().as_secs_f64();
            let t0 = Instant::now();
            net = adam.step(3e-4, net, &mut g);
            a += t0.elapsed().as_secs_f64();
        }
        let s = t.elapsed().as_secs_f64();
        let flop = 3.0 * 2.0 * 256.0 * (17.0 * 256.0 + 256.0 * 256.0 + 256.0) * (p * n) as f64;
        println!("{phase}: {:.0} member-updates/s, {:.1} GFLOP/s; forward {:.3} backward {:.3} adam {:.3} ms", (p * n) as f64 / s, flop / s / 1e9, f / n as f64 * 1e3, b / n as f64 * 1e3, a / n as f64 * 1e3);
    }
    let v = net.valid();
    let xi = x.inner();
    let t = Instant::now();
    for _ in 0..n { std::hint::black_box(v.forward(xi.clone())); }
    let s = t.elapsed().as_secs_f64();
    println!("forward only: {:.3} ms", s / n as f64 * 1e3);
}
