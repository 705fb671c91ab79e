//! Evaluates networks on whole tables, all members in parallel, in blocks of rows.

use tce_nn::{Device, Tensor, host, tensor};

/// Rows per block. It is part of the definition of results that draw noise per block.
const BLOCK: usize = 1024;

/// Applies `f` to the rows of every member's table and returns its results, per member, row-major.
///
/// `tables[m]` holds rows of `width`. Members may have different numbers of rows (shorter tables are padded with zeros
/// and the results dropped). `f` gets the index of the block and `[P, rows, width]`, and returns `[P, k · rows, ·]`
/// with the k results of a row together.
pub fn map_rows(
    tables: &[Vec<f32>],
    width: usize,
    device: &Device,
    mut f: impl FnMut(usize, Tensor<3>) -> Tensor<3>,
) -> Vec<Vec<f32>> {
    let longest = tables.iter().map(|t| t.len() / width).max().unwrap_or(0);
    let mut out = vec![Vec::new(); tables.len()];
    for (block, first) in (0..longest).step_by(BLOCK).enumerate() {
        let rows = BLOCK.min(longest - first);
        let range = |t: &Vec<f32>| (first * width).min(t.len())..((first + rows) * width).min(t.len());
        let mut data = Vec::with_capacity(tables.len() * rows * width);
        for (m, table) in tables.iter().enumerate() {
            data.extend_from_slice(&table[range(table)]);
            data.resize((m + 1) * rows * width, 0.0);
        }
        let results = host(f(block, tensor(data, [tables.len(), rows, width], device)));
        let per_row = results.len() / (tables.len() * rows);
        for ((out, table), results) in out.iter_mut().zip(tables).zip(results.chunks(rows * per_row)) {
            out.extend_from_slice(&results[..range(table).len() / width * per_row]);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use tce_nn::cpu;

    #[test]
    fn every_row_comes_back_to_its_member() {
        let table = |rows: usize, base: f32| (0..2 * rows).map(|v| v as f32 + base).collect::<Vec<_>>();
        let tables = [table(2500, 0.0), table(3, 0.5), Vec::new()];
        let twice = |_, x: Tensor<3>| {
            let [p, rows, width] = x.dims();
            x.reshape([p, rows, 1, width]).expand([p, rows, 2, width]).reshape([p, 2 * rows, width])
        };
        let out = map_rows(&tables, 2, &cpu(), twice);
        for (out, table) in out.iter().zip(&tables) {
            let expected: Vec<f32> = table.chunks(2).flat_map(|r| [r[0], r[1], r[0], r[1]]).collect();
            assert_eq!(*out, expected);
        }
    }
}
