//! Between host memory and tensors.

use burn::tensor::{Device, Tensor, TensorData};

/// A host array `[P, B, D]` as a tensor.
///
/// # Panics
/// If `data` has another length than the shape says.
pub fn tensor(data: Vec<f32>, shape: [usize; 3], device: &Device) -> Tensor<3> {
    Tensor::from_data(TensorData::new(data, shape), device)
}

/// A tensor as a host array, row-major; detached from any autodiff graph.
pub fn host<const D: usize>(t: Tensor<D>) -> Vec<f32> {
    t.inner().into_data().try_into_vec().expect("tensors of this program are f32")
}

/// A minibatch under construction: members of a population side by side, each with its own rows.
#[derive(Clone, Debug)]
pub struct Batch {
    data: Vec<f32>,
    width: usize,
    members: usize,
}

impl Batch {
    /// Room for `members` × `rows` rows of `width`.
    pub fn new(members: usize, rows: usize, width: usize) -> Self {
        Self { data: Vec::with_capacity(members * rows * width), width, members }
    }

    /// Appends row `index` of a row-major table of this batch's width.
    pub fn push(&mut self, table: &[f32], index: usize) {
        self.data.extend_from_slice(&table[index * self.width..(index + 1) * self.width]);
    }

    /// The batch as `[members, rows, width]`.
    pub fn into_tensor(self, device: &Device) -> Tensor<3> {
        let rows = self.data.len() / (self.members * self.width);
        tensor(self.data, [self.members, rows, self.width], device)
    }
}

/// Learning rate after `step` of `steps` under cosine annealing to zero.
pub fn cosine_decay(base: f64, step: u64, steps: u64) -> f64 {
    let progress = (step as f64 / steps.max(1) as f64).min(1.0);
    base * 0.5 * (1.0 + (std::f64::consts::PI * progress).cos())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cosine_goes_from_the_base_to_zero() {
        assert_eq!(cosine_decay(3e-4, 0, 100), 3e-4);
        assert!((cosine_decay(3e-4, 50, 100) - 1.5e-4).abs() < 1e-12);
        assert!(cosine_decay(3e-4, 100, 100).abs() < 1e-12);
    }
}
