//! Finds the data set that a field's name refers to, through any links.

use std::fs;
use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use hdf5_pure::Superblock;

use super::image::{Image, Patch, malformed};
use super::table::{Link, Links};

/// Largest number of soft links that one name may pass through: HDF5's own default.
const MAX_LINKS: usize = 16;

/// What a name at the top level refers to.
pub(super) enum Found {
    /// There is no such name.
    Absent,
    /// The object at this path of hard links, which `hdf5-pure` can follow.
    At { path: String, header: u64 },
    /// A link that leads to no object in this file.
    Nowhere(Broken),
    /// A group, with the names of its members.
    Group(Vec<String>),
}

/// Why a link leads to no object.
pub(super) enum Broken {
    /// It leads to a path that does not exist.
    Dangling(String),
    /// It passes through more than [`MAX_LINKS`] links.
    Circle(String),
    /// It leads to another file.
    External { file: String, path: String },
    /// Its kind is known only to the program that wrote it.
    Unknown(u8),
}

/// The names at the file's top level.
pub(super) struct Names {
    image: Image,
    root: u64,
    top: Links,
    /// Header and links of the last group at the top level that was looked into. robomimic's `data` holds all episodes.
    recent: Mutex<Option<(u64, Arc<Links>)>>,
}

impl Names {
    pub fn open(path: &Path, bytes: u64, superblock: &Superblock) -> io::Result<Self> {
        let image = Image::new(fs::File::open(path)?, bytes, superblock);
        // The library adds the base (the bytes of a user block) to this one address.
        let root = superblock.root_group_address.checked_sub(superblock.base_address.get());
        let root = root.ok_or_else(|| malformed("a root before the start of the file"))?;
        let top = image.links(root)?.ok_or_else(|| malformed("a root that is not a group"))?;
        Ok(Self { image, root, top, recent: Mutex::default() })
    }

    /// Whether `name` exists at the top level or at the end of a path. A link that leads to no object counts.
    pub fn has(&self, name: &str) -> bool {
        match name.split_once('/') {
            None => self.top.contains_key(name),
            Some(_) => matches!(self.find(name), Ok(Found::At { .. } | Found::Group(_) | Found::Nowhere(_))),
        }
    }

    /// All names at the top level; group names end with a slash.
    pub fn list(&self) -> Vec<String> {
        let group = |link: &Link| matches!(link, Link::Hard(a) if matches!(self.image.links(*a), Ok(Some(_))));
        self.top.iter().map(|(name, link)| if group(link) { format!("{name}/") } else { name.clone() }).collect()
    }

    /// The object that `name`, or a path of names, leads to. The empty name is the top level.
    pub fn find(&self, name: &str) -> io::Result<Found> {
        if name.is_empty() {
            return Ok(Found::Group(self.top.keys().cloned().collect()));
        }
        let Some(first) = self.top.get(name.split('/').next().unwrap_or_default()) else {
            return Ok(Found::Absent);
        };
        let dangling = || match first {
            Link::Soft(target) => Found::Nowhere(Broken::Dangling(target.clone())),
            _ => Found::Absent,
        };
        let (mut at, mut path) = (self.root, Vec::new());
        let mut followed = 0;
        // The parts of the path that are still to follow, in reverse order.
        let mut parts: Vec<String> = name.split('/').rev().map(str::to_owned).collect();
        while let Some(part) = parts.pop() {
            if part.is_empty() || part == "." {
                continue;
            }
            let inner;
            let table = if at == self.root {
                &self.top
            } else {
                let Some(links) = self.links(at, path.len())? else {
                    return Ok(dangling());
                };
                inner = links;
                &*inner
            };
            match table.get(&part) {
                None => return Ok(dangling()),
                Some(Link::Hard(address)) => {
                    at = *address;
                    path.push(part);
                }
                Some(Link::Soft(target)) => {
                    followed += 1;
                    if followed > MAX_LINKS {
                        return Ok(Found::Nowhere(Broken::Circle(target.clone())));
                    }
                    if target.starts_with('/') {
                        at = self.root;
                        path.clear();
                    }
                    parts.extend(target.split('/').rev().map(str::to_owned));
                }
                Some(Link::External { file, path }) => {
                    let (file, path) = (file.clone(), path.clone());
                    return Ok(Found::Nowhere(Broken::External { file, path }));
                }
                Some(Link::Unknown(kind)) => return Ok(Found::Nowhere(Broken::Unknown(*kind))),
            }
        }
        match self.links(at, path.len())? {
            Some(members) => Ok(Found::Group(members.keys().cloned().collect())),
            None => Ok(Found::At { path: path.join("/"), header: at }),
        }
    }

    /// The links of the group with the object header at `header`, `depth` names below the top level; `None` if the object
    /// is not a group.
    fn links(&self, header: u64, depth: usize) -> io::Result<Option<Arc<Links>>> {
        let mut recent = self.recent.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, links)) = recent.as_ref().filter(|(at, _)| *at == header) {
            return Ok(Some(Arc::clone(links)));
        }
        let links = self.image.links(header)?.map(Arc::new);
        if depth == 1 && links.is_some() {
            *recent = links.clone().map(|links| (header, links));
        }
        Ok(links)
    }

    /// The patch for a data set that the library does not read in its stored form.
    pub fn readable_layout(&self, header: u64) -> io::Result<Option<Patch>> {
        self.image.readable_layout(header)
    }
}
