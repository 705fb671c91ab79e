//! The matrix product that neighbours and transport share.

use gemm::Parallelism;

/// Points stored coordinate by coordinate (`[dim, len]`), the order in which the product reads them.
pub(crate) struct Transposed {
    pub data: Vec<f32>,
    pub len: usize,
    pub dim: usize,
}

impl Transposed {
    /// Transposes row-major `[len, dim]`.
    pub fn from_rows(rows: &[f32], dim: usize) -> Self {
        let len = rows.len() / dim;
        let mut data = vec![0.0; rows.len()];
        for (j, row) in rows.chunks_exact(dim).enumerate() {
            for (d, &x) in row.iter().enumerate() {
                data[d * len + j] = x;
            }
        }
        Self { data, len, dim }
    }

    /// `out[i * count + j] = alpha * <x_i, y_{first + j}>` for the row-major points `x` (`[rows, dim]`) and `count` of
    /// the points of `self` from `first` on. Runs on the calling thread only: callers split the rows.
    pub fn dot(&self, x: &[f32], first: usize, count: usize, alpha: f32, out: &mut [f32]) {
        let rows = x.len() / self.dim;
        assert!(x.len() == rows * self.dim && first + count <= self.len && out.len() >= rows * count);
        // SAFETY: the product reads `dim` columns of `count` elements, `len` apart, from `first` on, and `rows` columns
        // of `dim` elements of `x`; it writes `rows` columns of `count` elements. The assertion bounds all three, and
        // the borrow rules keep `out` apart from the inputs.
        unsafe {
            gemm::gemm(
                count,
                rows,
                self.dim,
                out.as_mut_ptr(),
                count as isize,
                1,
                false,
                self.data.as_ptr().add(first),
                self.len as isize,
                1,
                x.as_ptr(),
                self.dim as isize,
                1,
                0.0f32,
                alpha,
                false,
                false,
                false,
                Parallelism::None,
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_the_dot_product_of_every_pair() {
        let y: Vec<f32> = (0..15).map(|i| i as f32 - 7.0).collect();
        let x: Vec<f32> = (0..6).map(|i| 0.5 * i as f32).collect();
        let t = Transposed::from_rows(&y, 3);
        let mut out = vec![f32::NAN; 6];
        t.dot(&x, 1, 3, 2.0, &mut out);
        for i in 0..2 {
            for j in 0..3 {
                let want: f32 = (0..3).map(|d| 2.0 * x[i * 3 + d] * y[(j + 1) * 3 + d]).sum();
                assert_eq!(out[i * 3 + j], want);
            }
        }
    }
}
