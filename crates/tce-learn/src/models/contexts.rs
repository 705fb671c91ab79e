//! Contexts of rows under a finished world model. Each is needed many times, but computed only once.

use std::collections::BTreeSet;

use rayon::prelude::*;
use tce_nn::{Device, Module, host};

use crate::buffer::{Buffer, Pick};
use crate::context_encoder::ContextEncoder;
use crate::sequences::{Segments, Trajectories};
use crate::world_model::strip;

/// The rows of a member, and what computes their contexts.
#[derive(Clone, Copy)]
pub(crate) struct Of<'a> {
    pub trajectories: &'a Trajectories,
    pub encoder: &'a ContextEncoder,
    pub buffer: &'a Buffer,
    pub member: usize,
    pub device: &'a Device,
}

/// z of the rows of a member's tables, under a world model that no longer changes.
///
/// They are computed on first use, in fixed blocks, so that a resumed training run gets the same bits: a matrix product
/// may round a row differently if the other rows differ.
#[derive(Clone, Debug)]
pub(crate) struct Contexts {
    latent: usize,
    tables: Vec<TableContexts>,
}

#[derive(Clone, Debug)]
struct TableContexts {
    values: Vec<f32>,
    /// For each block, whether it has been computed.
    known: Vec<bool>,
}

/// Rows per block. It is small, because the segments of the first training steps touch one block for almost every row.
const BLOCK: usize = 64;

impl Contexts {
    /// An empty cache.
    pub(crate) fn new(trajectories: &Trajectories, latent: usize) -> Self {
        let table =
            |rows: usize| TableContexts { values: vec![0.0; rows * latent], known: vec![false; rows.div_ceil(BLOCK)] };
        Self { latent, tables: trajectories.rows().map(table).collect() }
    }

    /// z of the steps of `segments`, `[B, K, Z]` row-major; zeros after the last step.
    pub(crate) fn of(
        &mut self,
        segments: &Segments,
        steps: usize,
        Of { trajectories, encoder, buffer, member, device }: Of,
    ) -> Vec<f32> {
        let encoder = encoder.valid();
        let rows = |(pick, valid): (&Pick, &[f32])| {
            let length = valid.iter().filter(|v| **v > 0.0).count();
            (pick.part as usize, pick.row as usize + 1 - length..pick.row as usize + 1)
        };
        let rows: Vec<_> = segments.picks.iter().zip(segments.valid.chunks_exact(steps)).map(rows).collect();
        let blocks = rows.iter().flat_map(|(part, r)| (r.start / BLOCK..=(r.end - 1) / BLOCK).map(|b| (*part, b)));
        let missing: BTreeSet<_> = blocks.filter(|&(part, b)| !self.tables[part].known[b]).collect();
        let computed: Vec<_> = missing
            .into_par_iter()
            .map(|(part, block)| {
                let end = self.tables[part].values.len() / self.latent;
                let range = block * BLOCK..end.min((block + 1) * BLOCK);
                let size = range.len();
                let segments = trajectories.block(buffer, member, part, range, encoder.horizon);
                (part, block, host(encoder.contexts(strip(&segments, size, device))))
            })
            .collect();
        for (part, block, values) in computed {
            let table = &mut self.tables[part];
            table.values[block * BLOCK * self.latent..][..values.len()].copy_from_slice(&values);
            table.known[block] = true;
        }
        let mut out = Vec::with_capacity(rows.len() * steps * self.latent);
        for (k, (part, rows)) in rows.into_iter().enumerate() {
            out.extend_from_slice(&self.tables[part].values[rows.start * self.latent..rows.end * self.latent]);
            out.resize((k + 1) * steps * self.latent, 0.0);
        }
        out
    }
}
