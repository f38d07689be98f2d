//! The files of several nodes as one file, on the clock of one of them.

#[cfg(test)]
mod tests;

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BinaryHeap},
    fs::{self, OpenOptions},
    io::{self, BufWriter, Write as _},
    os::unix::fs::OpenOptionsExt as _,
    path::Path,
    sync::Arc,
};

use mcap::{WriteOptions, records::MessageHeader};
use serde::Serialize;

use crate::{
    clocks::{Clocks, Way},
    error::BagError,
    read::{Channel, Ordered, OwnedMessage},
    writer::{METADATA, cause},
};

/// The name of the metadata record that states the clocks and the former files of a merged file.
pub(crate) const MERGED: &str = "sinew.merged";
/// Its field with the names of the former files.
pub(crate) const MERGED_FILES: &str = "files";
/// Maximum names in it.
const FILES_MAX: usize = 64;
/// Its field with the losses of the former files, a line for each; absent if all were whole.
pub(crate) const MERGED_LOSSES: &str = "losses";
/// Maximum lines in it.
pub(crate) const LOSSES_MAX: usize = 16;

/// A node of a merged file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct MergedNode {
    /// Its address.
    pub address: String,
    /// Its name.
    pub node: String,
    /// How wrong its times may be against those of the reference, in nanoseconds.
    pub bound_ns: u64,
    /// Its messages.
    pub messages: u64,
}

/// The result of [`merge()`].
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Merged {
    /// The address of the node with the clock of the file.
    pub reference: String,
    /// The nodes.
    pub nodes: Vec<MergedNode>,
    /// Damaged records, which were skipped.
    pub damage: Vec<String>,
    /// A line for each unfinished file: its end is missing from a byte and a time on.
    pub unfinished: Vec<String>,
}

/// A file that is being merged.
struct Source {
    ordered: Ordered,
    /// The node, as a place in [`Merged::nodes`].
    node: usize,
    way: Way,
    /// Its channels in the merged file.
    ids: BTreeMap<u16, u16>,
    next: Option<OwnedMessage>,
    /// The time of the last message in the merged file.
    last_ns: u64,
}

impl Source {
    /// Returns the time of the next message in the merged file.
    ///
    /// Where two readings of a clock are near each other and differ, the converted time runs backwards for less than
    /// their bounds. The merged file has the earlier time then, which is within the bound, too.
    fn next_ns(&mut self) -> Option<u64> {
        let message = self.next.as_ref()?;
        self.last_ns = self.last_ns.max(self.way.convert(message.log_ns).0);
        Some(self.last_ns)
    }
}

/// Merges files into one, in the order of their times. Each topic gets the name of its node in front.
///
/// The clock is that of the first file's node. The times of others are converted by the clock readings in the files,
/// also across a third node; the metadata record `sinew.merged` states how wrong they may be, and the names of `files`.
///
/// The order of a merged file is that of its times, so its tallies do not prove it complete:
/// [`check()`](crate::check()) refuses it. Check `files` before.
///
/// # Errors
/// A file cannot be read, `out` exists or cannot be written, two files are the same part of one recording, or no clock
/// reading connects a node with the reference. A file that cannot be completed is removed.
pub fn merge<P: AsRef<Path>>(files: &[P], out: impl AsRef<Path>) -> Result<Merged, BagError> {
    let out = out.as_ref();
    let clocks = Clocks::read(files)?;
    let mut merged = Merged::default();
    let (mut sources, mut given) = (Vec::new(), BTreeMap::new());
    for path in files {
        let path = path.as_ref();
        let source = open(path, &clocks, &mut merged)?;
        if let Some(former) = given.insert(identity(&source.ordered), path) {
            return Err(twice(former, path));
        }
        sources.push(source);
    }
    let file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(out);
    let file = file.map_err(|error| BagError::write(out, error))?;
    let written = write(BufWriter::new(file), &mut sources, &mut merged, names(files));
    written.map_err(|fault| {
        // The file was created above, and a part of it is useless. If this fails, too, the first failure counts.
        let _ = fs::remove_file(out);
        match fault {
            MergeError::Read(error) => error,
            MergeError::Write(error) => BagError::write(out, error),
        }
    })?;
    Ok(merged)
}

/// Returns the fields that no other file of any recording has: node, incarnation, begin of the recording, and part.
fn identity(file: &Ordered) -> [String; 4] {
    let text =
        |key: &str| file.metadata(METADATA).and_then(|fields| fields.get(key)).cloned().unwrap_or_default();
    ["address", "incarnation", "began_ns", "part"].map(text)
}

/// Returns why two files are refused that have one content: each of its messages would be there twice.
fn twice(former: &Path, path: &Path) -> BagError {
    let (former, path) = (former.display(), path.display());
    BagError::Unfit(format!("{former} and {path} are the same part of one recording; give only one of them"))
}

/// Returns the names of the first files, without their folders.
fn names<P: AsRef<Path>>(files: &[P]) -> String {
    let name = |path: &P| path.as_ref().file_name().unwrap_or_default().to_string_lossy().into_owned();
    let mut names: Vec<_> = files.iter().take(FILES_MAX).map(name).collect();
    if files.len() > FILES_MAX {
        names.push("...".to_owned());
    }
    names.join(" ")
}

fn open(path: &Path, clocks: &Clocks, merged: &mut Merged) -> Result<Source, BagError> {
    let mut ordered = Ordered::open(path)?;
    merged.damage.extend_from_slice(ordered.damage());
    merged.unfinished.extend(ordered.missing_end().map(str::to_owned));
    let text = |key: &str| {
        ordered.metadata(METADATA).and_then(|fields| fields.get(key)).cloned().unwrap_or_default()
    };
    let (address, node) = (text("address"), text("node"));
    let way = clocks.way(path)?;
    if merged.reference.is_empty() {
        merged.reference.clone_from(&address);
    }
    let place = merged.nodes.iter().position(|known| known.address == address);
    let place = place.unwrap_or_else(|| {
        merged.nodes.push(MergedNode { address, node, bound_ns: 0, messages: 0 });
        merged.nodes.len() - 1
    });
    let next = ordered.next_message()?;
    Ok(Source { ordered, node: place, way, ids: BTreeMap::new(), next, last_ns: 0 })
}

enum MergeError {
    Read(BagError),
    Write(io::Error),
}

impl From<mcap::McapError> for MergeError {
    fn from(error: mcap::McapError) -> Self {
        Self::Write(cause(error))
    }
}

fn write(
    file: BufWriter<fs::File>,
    sources: &mut [Source],
    merged: &mut Merged,
    files: String,
) -> Result<(), MergeError> {
    let options = WriteOptions::new().compression(Some(mcap::Compression::Zstd)).compression_threads(0);
    let mut writer = options.library(concat!("sinew-bag/", env!("CARGO_PKG_VERSION"))).create(file)?;
    let mut next = BinaryHeap::new();
    for (at, source) in sources.iter_mut().enumerate() {
        if let Some(log_ns) = source.next_ns() {
            next.push(Reverse((log_ns, at)));
        }
    }
    let mut sequence = 0_u64;
    while let Some(Reverse((log_time, at))) = next.pop() {
        let source = &mut sources[at];
        let Some(message) = source.next.take() else { continue };
        let (publish_time, bound_ns) = source.way.convert(message.publish_ns);
        let node = &mut merged.nodes[source.node];
        node.bound_ns = node.bound_ns.max(bound_ns);
        node.messages += 1;
        let channel_id = match source.ids.get(&message.channel.id) {
            Some(id) => *id,
            None => {
                let id = declare(&mut writer, &message.channel, node)?;
                source.ids.insert(message.channel.id, id);
                id
            }
        };
        let header = MessageHeader { channel_id, sequence: message.sequence, log_time, publish_time };
        writer.write_to_known_channel(&header, &message.data)?;
        sequence += 1;
        source.next = source.ordered.next_message().map_err(MergeError::Read)?;
        if let Some(log_ns) = source.next_ns() {
            next.push(Reverse((log_ns, at)));
        }
    }
    let mut metadata = BTreeMap::from([
        ("reference".to_owned(), merged.reference.clone()),
        ("messages".to_owned(), sequence.to_string()),
        (MERGED_FILES.to_owned(), files),
    ]);
    for MergedNode { address, bound_ns, .. } in &merged.nodes {
        metadata.insert(format!("bound_ns {address}"), bound_ns.to_string());
    }
    let losses: Vec<_> = merged.unfinished.iter().chain(&merged.damage).take(LOSSES_MAX).cloned().collect();
    if !losses.is_empty() {
        metadata.insert(MERGED_LOSSES.to_owned(), losses.join("\n"));
    }
    writer.write_metadata(&mcap::records::Metadata { name: MERGED.to_owned(), metadata })?;
    writer.finish()?;
    writer.into_inner().flush().map_err(MergeError::Write)
}

/// Adds a channel under the name of its node.
fn declare<W: io::Write + io::Seek>(
    writer: &mut mcap::Writer<W>,
    channel: &Arc<Channel>,
    node: &MergedNode,
) -> Result<u16, mcap::McapError> {
    let schema = match &channel.schema {
        Some(schema) => writer.add_schema(&schema.name, &schema.encoding, &schema.data)?,
        None => 0,
    };
    let name = if node.node.is_empty() { &node.address } else { &node.node };
    let mut metadata = channel.metadata.clone();
    metadata.insert("sinew.node".to_owned(), node.address.clone());
    writer.add_channel(schema, &format!("/{name}{}", channel.topic), &channel.encoding, &metadata)
}
