//! What the machine can do, to hold measurements against.

use std::time::Instant;

use crate::gemm::{Finish, Isa, Matrix, Packed, Right, product};
use crate::kernels::room;

/// Rows and columns of the products.
const SIZE: usize = 256;

/// GFLOP/s of the calling thread in products of 256 × 256 matrices with a right operand packed before: the median over
/// `seconds`. A machine that others use, or that clocks down, shows it here.
pub fn product_rate(seconds: f64) -> f64 {
    let (a, b) = (vec![0.5; SIZE * SIZE], Packed::new(Matrix::plain(&[0.5; SIZE * SIZE], SIZE), SIZE, SIZE));
    let mut out = room(SIZE * SIZE);
    let started = Instant::now();
    let mut times = Vec::new();
    while times.len() < 3 || started.elapsed().as_secs_f64() < seconds {
        let begin = Instant::now();
        product(&mut out, Matrix::plain(&a, SIZE), Right::Packed(&b), [SIZE; 3], Finish::Store);
        times.push(begin.elapsed().as_secs_f64());
    }
    times.sort_by(f64::total_cmp);
    2.0 * (SIZE * SIZE * SIZE) as f64 / times[times.len() / 2] / 1e9
}

/// The instruction set of the products.
pub fn instructions() -> &'static str {
    match Isa::best() {
        #[cfg(target_arch = "x86_64")]
        Isa::Avx512 => "AVX-512",
        #[cfg(target_arch = "x86_64")]
        Isa::Avx2 => "AVX2",
        _ => "portable kernels",
    }
}

/// The processor's name, as the kernel tells it.
pub fn processor() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let line = info.lines().find(|l| l.starts_with("model name"));
    line.and_then(|l| l.split(": ").nth(1)).unwrap_or("unknown").to_owned()
}

/// Processor and instruction set: what decides the bytes of a result besides its inputs.
pub fn machine() -> String {
    format!("{}, {}", processor(), instructions())
}
