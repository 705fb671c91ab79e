//! Reads the link tables of groups from the file's bytes.
//!
//! `hdf5-pure` follows hard links only: it does not list soft and external links, or returns an error for them. So the
//! names are read here: object headers (versions 1 and 2), symbol tables (old-style groups), link messages (new-style
//! groups) and dense link storage (new-style groups of more than eight links: a fractal heap indexed by a version 2
//! B-tree). No number in the file is trusted: every read is checked against the file's length and
//! [`super::image::MAX_READ`].

use std::collections::BTreeMap;
use std::io::Result;

use super::heap::Heap;
use super::image::{Fields, Image, MAX_READ, Patch, malformed};
use super::modern::{self, lookup3};

/// Most nodes of one tree. This limits the work on a damaged file, whose nodes may form a cycle.
const MAX_NODES: usize = 100_000;

const LINK_INFO: u16 = 0x02;
const LINK: u16 = 0x06;
const LAYOUT: u16 = 0x08;
const CONTINUATION: u16 = 0x10;
const SYMBOL_TABLE: u16 = 0x11;

/// One entry of a group.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Link {
    /// The object whose header is at this address.
    Hard(u64),
    /// Another path of the same file.
    Soft(String),
    /// A path of another file.
    External { file: String, path: String },
    /// A kind of link that only the writing program knows.
    Unknown(u8),
}

/// One message of an object header.
struct Message {
    kind: u16,
    body: Vec<u8>,
    /// Bytes before the body: its kind, then its size.
    prefix: Vec<u8>,
    /// Address of the body.
    at: u64,
    /// Address and length of the bytes under the block's checksum, which follows them. Old headers have none.
    checked: Option<(u64, u64)>,
}

pub(super) type Links = BTreeMap<String, Link>;

/// The text before the first NUL byte.
fn until_nul(bytes: &[u8]) -> Result<String> {
    let end = bytes.iter().position(|&b| b == 0).ok_or_else(|| malformed("a name without an end"))?;
    Ok(String::from_utf8_lossy(&bytes[..end]).into_owned())
}

impl Image {
    /// The links of the group with the object header at `header`; `None` if the object is not a group.
    pub fn links(&self, header: u64) -> Result<Option<Links>> {
        let mut links = Links::new();
        let mut group = false;
        for Message { kind, body, .. } in self.messages(header)? {
            let mut f = Fields(&body);
            match kind {
                SYMBOL_TABLE => {
                    group = true;
                    let (tree, heap) = (f.uint(self.offset)?, f.uint(self.offset)?);
                    self.symbol_table(tree, heap, &mut links)?;
                }
                LINK => {
                    group = true;
                    let (name, link) = self.link(&body)?;
                    links.insert(name, link);
                }
                LINK_INFO => {
                    group = true;
                    f.byte()?;
                    let flags = f.byte()?;
                    if flags & 1 != 0 {
                        f.take(8)?;
                    }
                    let (heap, index) = (f.uint(self.offset)?, f.uint(self.offset)?);
                    if !self.undefined(heap) && !self.undefined(index) {
                        for message in Heap::open(self, heap)?.all(index)? {
                            let (name, link) = self.link(&message)?;
                            links.insert(name, link);
                        }
                    }
                }
                _ => {}
            }
        }
        Ok(group.then_some(links))
    }

    /// Patches a data set's header: replaces a layout message that the library does not read by one that it reads.
    /// `None` if it reads the existing message. See [`modern`](super::modern).
    pub fn readable_layout(&self, header: u64) -> Result<Option<Patch>> {
        let layout = self.messages(header)?.into_iter().find(|m| m.kind == LAYOUT);
        let Some((Message { body, mut prefix, at, checked: Some((start, length)), .. }, new)) =
            layout.and_then(|m| modern::rewritten(&m.body).map(|new| (m, new)))
        else {
            return Ok(None);
        };
        // The new message may be longer. It is therefore stored in a block of its own after the file's end, and the old
        // message is replaced by a continuation message with its address.
        if body.len() < self.offset + self.length {
            return Ok(None);
        }
        prefix[1..3].copy_from_slice(&(new.len() as u16).to_le_bytes());
        let mut behind = [b"OCHK", &prefix[..], &new].concat();
        behind.extend(lookup3(&behind).to_le_bytes());
        let mut bytes = self.read(start, length + 4)?;
        let (old, sum) = bytes.split_at_mut(length as usize);
        if *sum != lookup3(old).to_le_bytes() {
            return Err(malformed("an object header with a wrong checksum"));
        }
        let at = (at - start) as usize;
        old[at - prefix.len()] = CONTINUATION as u8;
        let target = &mut old[at..at + body.len()];
        target.fill(0);
        target[..self.offset].copy_from_slice(&(self.bytes - self.base).to_le_bytes()[..self.offset]);
        target[self.offset..][..self.length].copy_from_slice(&(behind.len() as u64).to_le_bytes()[..self.length]);
        sum.copy_from_slice(&lookup3(old).to_le_bytes());
        Ok(Some(Patch { start: self.base + start, bytes, behind }))
    }

    /// The messages of an object header that are used here.
    fn messages(&self, header: u64) -> Result<Vec<Message>> {
        let start = self.read(header, 4)?;
        let modern = start == *b"OHDR";
        // Blocks still to read: address of the first message, the messages, the range under the checksum.
        let mut blocks = Vec::new();
        let mut order = false;
        if modern {
            let flags = self.read(header, 6)?[5];
            let times = if flags & 0x20 != 0 { 16 } else { 0 };
            let attributes = if flags & 0x10 != 0 { 4 } else { 0 };
            order = flags & 0x04 != 0;
            let width = 1 << (flags & 3);
            let prefix = 6 + times + attributes + width;
            let size = Fields(&self.read(header, prefix)?[(prefix - width) as usize..]).uint(width as usize)?;
            let at = header + prefix;
            blocks.push((at, self.read(at, size)?, Some((header, prefix + size))));
        } else if start[0] == 1 {
            let prefix = self.read(header, 16)?;
            let size = Fields(&prefix[8..]).uint(4)?;
            blocks.push((header + 16, self.read(header + 16, size)?, None));
        } else {
            return Err(malformed(format!("object header version {}", start[0])));
        }
        let mut messages = Vec::new();
        let mut left = MAX_READ;
        while let Some((first, block, checked)) = blocks.pop() {
            let mut f = Fields(&block);
            let prefix = if modern { 4 + 2 * usize::from(order) } else { 8 };
            // A remainder shorter than a message is a gap.
            while f.0.len() >= prefix {
                let before = f.take(prefix)?;
                let mut head = Fields(before);
                let kind = if modern { u16::from(head.byte()?) } else { head.uint(2)? as u16 };
                let size = head.uint(2)? as usize;
                let at = first + (block.len() - f.0.len()) as u64;
                let body = f.take(size)?;
                if kind == CONTINUATION {
                    let mut c = Fields(body);
                    let (address, length) = (c.uint(self.offset)?, c.uint(self.length)?);
                    left =
                        left.checked_sub(length.max(8)).ok_or_else(|| malformed("an object header without an end"))?;
                    let more = self.read(address, length)?;
                    blocks.push(if modern {
                        let inner =
                            more.strip_prefix(b"OCHK").and_then(|b| b.len().checked_sub(4).map(|end| &b[..end]));
                        let inner = inner.ok_or_else(|| malformed("no OCHK block where one should be"))?;
                        (address + 4, inner.to_vec(), Some((address, length - 4)))
                    } else {
                        (address, more, None)
                    });
                } else if matches!(kind, LINK | LINK_INFO | SYMBOL_TABLE | LAYOUT) {
                    messages.push(Message { kind, body: body.to_vec(), prefix: before.to_vec(), at, checked });
                }
            }
        }
        Ok(messages)
    }

    /// Reads one link message.
    fn link(&self, message: &[u8]) -> Result<(String, Link)> {
        let mut f = Fields(message);
        let version = f.byte()?;
        if version != 1 {
            return Err(malformed(format!("link message version {version}")));
        }
        let flags = f.byte()?;
        let kind = if flags & 0x08 != 0 { f.byte()? } else { 0 };
        if flags & 0x04 != 0 {
            f.take(8)?; // creation order
        }
        if flags & 0x10 != 0 {
            f.byte()?; // character set
        }
        let length = f.uint(1 << (flags & 3))?;
        let name = f.text(usize::try_from(length).unwrap_or(usize::MAX))?;
        let link = match kind {
            0 => Link::Hard(f.uint(self.offset)?),
            1 => {
                let length = f.uint(2)? as usize;
                Link::Soft(f.text(length)?)
            }
            64 => {
                let length = f.uint(2)? as usize;
                let value = f.take(length)?;
                // One byte of version and flags, then two strings.
                let value = value.get(1..).unwrap_or_default();
                let file = until_nul(value)?;
                let rest = value.iter().position(|&b| b == 0).map_or(&[][..], |end| &value[end + 1..]);
                Link::External { file, path: until_nul(rest)? }
            }
            other => Link::Unknown(other),
        };
        Ok((name, link))
    }

    /// Reads an old-style group: a tree whose nodes hold entries, with the names in a heap.
    fn symbol_table(&self, tree: u64, heap: u64, links: &mut Links) -> Result<()> {
        let header = self.read(heap, 8 + 2 * self.length as u64 + self.offset as u64)?;
        let mut f = Fields(&header);
        f.signature("HEAP")?;
        f.take(4)?;
        let size = f.uint(self.length)?;
        f.take(self.length)?;
        let segment = self.read(f.uint(self.offset)?, size)?;
        // In a valid file names do not overlap, so their total length is at most that of the heap.
        let mut left = segment.len();
        let mut text = |at: u64| -> Result<String> {
            let rest = usize::try_from(at).ok().and_then(|at| segment.get(at..));
            let text = until_nul(rest.ok_or_else(|| malformed("a name outside of its heap"))?)?;
            left = left.checked_sub(text.len()).ok_or_else(|| malformed("names that overlap"))?;
            Ok(text)
        };
        let mut nodes = vec![(tree, None)];
        let mut visited = 0;
        while let Some((address, level)) = nodes.pop() {
            visited += 1;
            if visited > MAX_NODES {
                return Err(malformed("a tree of names without an end"));
            }
            if level == Some(0) {
                self.symbols(address, &mut text, links)?;
                continue;
            }
            let prefix = 8 + 2 * self.offset as u64;
            let head = self.read(address, prefix)?;
            let mut f = Fields(&head);
            f.signature("TREE")?;
            f.byte()?;
            let own = f.uint(1)?;
            let entries = f.uint(2)?;
            if level.is_some_and(|above| own + 1 != above) {
                return Err(malformed("a tree of names whose levels do not descend"));
            }
            let pair = (self.length + self.offset) as u64;
            let block = self.read(address, prefix + entries * pair)?;
            let mut f = Fields(&block[prefix as usize..]);
            for _ in 0..entries {
                f.take(self.length)?;
                // Level 0 of the tree points to nodes of entries, one level further down.
                nodes.push((f.uint(self.offset)?, Some(own)));
            }
        }
        Ok(())
    }

    /// Reads one node of entries of an old-style group.
    fn symbols(&self, address: u64, text: &mut impl FnMut(u64) -> Result<String>, links: &mut Links) -> Result<()> {
        let head = self.read(address, 8)?;
        let mut f = Fields(&head);
        f.signature("SNOD")?;
        f.take(2)?;
        let entries = f.uint(2)?;
        let size = (self.length + self.offset + 24) as u64;
        let block = self.read(address, 8 + entries * size)?;
        let mut f = Fields(&block[8..]);
        for _ in 0..entries {
            let name = text(f.uint(self.length)?)?;
            let object = f.uint(self.offset)?;
            let cached = f.uint(4)?;
            f.take(4)?;
            let scratch = f.take(16)?;
            // 2: a soft link. The scratch space holds the position of its path in the heap.
            let link = if cached == 2 { Link::Soft(text(Fields(scratch).uint(4)?)?) } else { Link::Hard(object) };
            links.insert(name, link);
        }
        Ok(())
    }
}
