//! Dense link storage: link messages in a fractal heap, found through a version 2 B-tree.

use std::io::Result;

use super::image::{Fields, Image, MAX_READ, malformed};

/// Most records of one index: far more links than a group of a transitions file has.
const MAX_RECORDS: u64 = 1 << 20;
/// Largest depth of the index, and of the heap's nested tables.
const MAX_DEPTH: u64 = 16;
/// Bytes of signature, version, type and checksum of a tree node.
const NODE_OVERHEAD: u64 = 10;

/// A fractal heap: blocks of doubling size, indexed by a table with `width` blocks per row.
pub(super) struct Heap<'a> {
    image: &'a Image,
    id_bytes: usize,
    offset_bytes: usize,
    length_bytes: usize,
    width: u64,
    first: u64,
    direct_rows: u64,
    root: u64,
    root_rows: u64,
}

/// Number of bytes that can hold every number up to `limit`.
fn bytes_for(limit: u64) -> usize {
    (limit.max(1).ilog2() / 8 + 1) as usize
}

impl<'a> Heap<'a> {
    pub fn open(image: &'a Image, address: u64) -> Result<Self> {
        let (o, l) = (image.offset, image.length);
        let header = image.read(address, (22 + 12 * l + 3 * o) as u64)?;
        let mut f = Fields(&header);
        f.signature("FRHP")?;
        f.byte()?;
        let id_bytes = f.uint(2)? as usize;
        if f.uint(2)? != 0 {
            return Err(malformed("a compressed table of names"));
        }
        f.byte()?;
        let largest_object = f.uint(4)?;
        // Skip huge objects, free space and counts.
        f.take(l + o + l + o + 8 * l)?;
        let width = f.uint(2)?;
        let first = f.uint(l)?;
        let largest_block = f.uint(l)?;
        let bits = f.uint(2)?;
        f.take(2)?;
        let root = f.uint(o)?;
        let root_rows = f.uint(2)?;
        if width == 0 || !first.is_power_of_two() || !largest_block.is_power_of_two() || largest_block < first {
            return Err(malformed("a table of names with impossible block sizes"));
        }
        let offset_bytes = bits.div_ceil(8) as usize;
        let length_bytes = bytes_for(largest_block).min(bytes_for(largest_object));
        if !(1..=8).contains(&offset_bytes) || 1 + offset_bytes + length_bytes > id_bytes {
            return Err(malformed("a table of names with impossible identifiers"));
        }
        // The first two rows have blocks of the first size.
        let direct_rows = u64::from(largest_block.ilog2() - first.ilog2()) + 2;
        Ok(Self { image, id_bytes, offset_bytes, length_bytes, width, first, direct_rows, root, root_rows })
    }

    /// All objects that the index at `address` lists.
    pub fn all(&self, address: u64) -> Result<Vec<Vec<u8>>> {
        let (o, l) = (self.image.offset, self.image.length);
        let header = self.image.read(address, (22 + o + l) as u64)?;
        let mut f = Fields(&header);
        f.signature("BTHD")?;
        f.take(2)?;
        let node = f.uint(4)?;
        let record = f.uint(2)?;
        let depth = f.uint(2)?;
        f.take(2)?;
        let root = f.uint(o)?;
        let records = f.uint(2)?;
        let total = f.uint(l)?;
        if record < 4 + self.id_bytes as u64 || node < NODE_OVERHEAD + record || depth > MAX_DEPTH {
            return Err(malformed("an index of names with impossible sizes"));
        }
        if total > MAX_RECORDS {
            return Err(malformed(format!("an index of {total} names")));
        }
        // Width of the counts in child pointers, for each level.
        let leaf = (node - NODE_OVERHEAD) / record;
        let mut index =
            Index { node, record, count_bytes: bytes_for(leaf), below: vec![leaf], left: total, bytes: MAX_READ };
        for level in 1..=depth {
            let pointer = index.pointer(o, level);
            let here = (node - NODE_OVERHEAD).saturating_sub(pointer) / (record + pointer);
            let below = index.below[level as usize - 1];
            index.below.push((here + 1).saturating_mul(below).saturating_add(here));
        }
        let mut objects = Vec::new();
        if total > 0 && !self.image.undefined(root) {
            self.node(&mut index, root, records, depth, &mut objects)?;
        }
        Ok(objects)
    }

    fn node(&self, index: &mut Index, at: u64, records: u64, depth: u64, objects: &mut Vec<Vec<u8>>) -> Result<()> {
        index.left = index.left.checked_sub(records).ok_or_else(|| malformed("an index of names without an end"))?;
        let pointer = if depth > 0 { index.pointer(self.image.offset, depth) } else { 0 };
        let size = 6 + records * index.record + (records + u64::from(depth > 0)) * pointer;
        let block = self.image.read(at, size.min(index.node))?;
        let mut f = Fields(&block);
        f.signature(if depth > 0 { "BTIN" } else { "BTLF" })?;
        f.take(2)?;
        for _ in 0..records {
            let mut entry = Fields(f.take(index.record as usize)?);
            entry.take(4)?; // hash of the name
            let object = self.object(entry.take(self.id_bytes)?)?;
            let left = index.bytes.checked_sub(object.len() as u64);
            index.bytes = left.ok_or_else(|| malformed("links that overlap"))?;
            objects.push(object);
        }
        if depth > 0 {
            for _ in 0..=records {
                let mut child = Fields(f.take(pointer as usize)?);
                let (address, count) = (child.uint(self.image.offset)?, child.uint(index.count_bytes)?);
                // An empty child would not reduce the remaining count, so it could be its own child without end.
                if count == 0 {
                    return Err(malformed("an index of names with an empty node"));
                }
                self.node(index, address, count, depth - 1, objects)?;
            }
        }
        Ok(())
    }

    /// The object with a heap identifier.
    fn object(&self, id: &[u8]) -> Result<Vec<u8>> {
        let mut f = Fields(id);
        match f.byte()? >> 4 & 3 {
            0 => {}
            2 => return Ok(f.take((id[0] & 0x0f) as usize + 1)?.to_vec()),
            _ => return Err(malformed("a link of more than four kilobytes")),
        }
        let offset = f.uint(self.offset_bytes)?;
        let length = f.uint(self.length_bytes)?;
        let (block, start) = self.block(offset)?;
        let address = block.checked_add(offset - start).ok_or_else(|| malformed("an address outside of the file"))?;
        self.image.read(address, length)
    }

    /// Address and heap offset of the block that holds `offset`.
    fn block(&self, offset: u64) -> Result<(u64, u64)> {
        let outside = || malformed("a name outside of its table");
        let (mut table, mut rows, mut start) = (self.root, self.root_rows, 0u64);
        if rows == 0 {
            return Ok((table, 0));
        }
        for _ in 0..MAX_DEPTH {
            // The row that contains it: rows 0 and 1 have blocks of the first size, each further row doubles the size.
            let place = offset - start;
            let units = place / self.first / self.width;
            let row = if units == 0 { 0 } else { u64::from(units.ilog2()) + 1 };
            if row >= rows {
                return Err(outside());
            }
            let size = self.first << row.saturating_sub(1);
            let row_start = if row == 0 { 0 } else { size * self.width };
            let column = (place - row_start) / size;
            let o = self.image.offset as u64;
            let children = 5 + o + self.offset_bytes as u64;
            self.image.read(table, children).and_then(|head| Fields(&head).signature("FHIB"))?;
            let at = table.checked_add(children + (row * self.width + column) * o).ok_or_else(outside)?;
            let child = Fields(&self.image.read(at, o)?).uint(o as usize)?;
            start += row_start + column * size;
            if row < self.direct_rows {
                return Ok((child, start));
            }
            table = child;
            // A child table has as many rows as its share of the heap needs.
            rows =
                (u64::from(size.ilog2())).saturating_sub(u64::from(self.first.saturating_mul(self.width).ilog2())) + 1;
        }
        Err(outside())
    }
}

/// The shape of a version 2 B-tree.
struct Index {
    node: u64,
    record: u64,
    count_bytes: usize,
    /// The largest number of records in and below a node, by level.
    below: Vec<u64>,
    /// Records that the header declares and that have not been read yet.
    left: u64,
    /// Bytes of links that may still be read.
    bytes: u64,
}

impl Index {
    /// Bytes of a child pointer in a node of this level: address, records in the child, records below it.
    fn pointer(&self, offset: usize, level: u64) -> u64 {
        let below = if level > 1 { bytes_for(self.below[level as usize - 1]) } else { 0 };
        (offset + self.count_bytes + below) as u64
    }
}
