//! Columns of a recording for spreadsheets and data frames: one file for each channel.

mod columnar;
mod columns;
mod comma;

#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, BTreeSet},
    fs, io,
    os::unix::fs::OpenOptionsExt as _,
    path::{Path, PathBuf},
    sync::Arc,
};

use serde::Serialize;

use crate::{
    error::{BagError, DamageList},
    read::{Channel, Header, Item, Message, Reader, Role},
};
use columns::{Columns, Row};

/// The format of exported files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Text with commas (RFC 4180).
    Csv,
    /// Apache Parquet, compressed with Snappy.
    Parquet,
}

impl Format {
    const fn ending(self) -> &'static str {
        match self {
            Self::Csv => "csv",
            Self::Parquet => "parquet",
        }
    }
}

/// A file that was written.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Exported {
    /// The topic.
    pub topic: String,
    /// The path.
    pub file: PathBuf,
    /// Messages.
    pub rows: u64,
    /// Columns of the payload and of the header.
    pub columns: usize,
    /// Values that are in no column, because the type has more of them than a file may have columns.
    pub left_out: u64,
}

/// The result of [`export()`].
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Exports {
    /// The files that were written.
    pub files: Vec<Exported>,
    /// Damaged records, which were skipped: the first 1,000, and the number of the others.
    pub damage: Vec<String>,
    /// The loss at the end of an unfinished recording: from which byte and which time on messages may be missing.
    pub unfinished: Option<String>,
}

/// A row of one channel, until the header behind it is read.
struct Pending {
    topic: String,
    row: Row,
}

/// A writer of rows.
trait Table {
    fn row(&mut self, row: &Row) -> io::Result<()>;
    fn finish(self: Box<Self>) -> io::Result<()>;
}

/// Writes a file for each channel of payloads into the folder `out`, which is made if it is absent. Columns are the
/// times, the header, and the values of the payload: `angle.degrees`, `joints.0`. The file is read twice: first for the
/// columns. Damaged records, and a missing end, are in the result: all that can be read is exported.
///
/// # Errors
/// The file cannot be read, or a file in `out` exists or cannot be written.
pub fn export(path: impl AsRef<Path>, out: impl AsRef<Path>, format: Format) -> Result<Exports, BagError> {
    let (path, out) = (path.as_ref(), out.as_ref());
    let mut all: BTreeMap<String, Columns> = BTreeMap::new();
    let (damage, unfinished) = read(path, |topic, row| {
        all.entry(topic.to_owned()).or_default().add(&row);
        Ok(())
    })?;
    fs::create_dir_all(out).map_err(|cause| BagError::write(out, cause))?;
    let (mut tables, mut exported, mut names) = (BTreeMap::new(), BTreeMap::new(), BTreeSet::new());
    for (topic, columns) in &all {
        let file = out.join(format!("{}.{}", name(topic, &mut names), format.ending()));
        let table = table(&file, columns, format).map_err(|cause| BagError::write(&file, cause))?;
        tables.insert(topic.clone(), (file.clone(), table));
        let (topic, columns, left_out) = (topic.clone(), columns.len(), columns.left_out());
        exported.insert(topic.clone(), Exported { topic, file, rows: 0, columns, left_out });
    }
    read(path, |topic, row| {
        let (Some((file, table)), Some(count)) = (tables.get_mut(topic), exported.get_mut(topic)) else {
            return Ok(());
        };
        count.rows += 1;
        table.row(&row).map_err(|cause| BagError::write(file, cause))
    })?;
    for (file, table) in tables.into_values() {
        table.finish().map_err(|cause| BagError::write(&file, cause))?;
    }
    Ok(Exports { files: exported.into_values().collect(), damage, unfinished })
}

fn table(file: &Path, columns: &Columns, format: Format) -> io::Result<Box<dyn Table>> {
    let opened = fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(file)?;
    Ok(match format {
        Format::Csv => Box::new(comma::Comma::new(opened, columns)?),
        Format::Parquet => Box::new(columnar::Parquet::new(opened, columns)?),
    })
}

/// Returns a file's name for a topic.
fn name(topic: &str, names: &mut BTreeSet<String>) -> String {
    let kept = |character: char| {
        if character.is_alphanumeric() || "._-".contains(character) { character } else { '_' }
    };
    let base: String = topic.trim_start_matches('/').replace('/', "__").chars().map(kept).collect();
    // No file is hidden, or above the folder.
    let base = if base.starts_with('.') || base.is_empty() { format!("_{base}") } else { base };
    let mut found = base.clone();
    for number in 2_u32.. {
        if names.insert(found.clone()) {
            break;
        }
        found = format!("{base}_{number}");
    }
    found
}

/// Reads the rows of all channels with payloads. Returns a line for each damaged record, and the loss at the end of an
/// unfinished file.
fn read(
    path: &Path,
    mut each: impl FnMut(&str, Row) -> Result<(), BagError>,
) -> Result<(Vec<String>, Option<String>), BagError> {
    let mut reader = Reader::open(path)?;
    let mut pending: Option<Pending> = None;
    let mut damage = DamageList::default();
    loop {
        let item = match reader.next_item() {
            Ok(Some(item)) => item,
            Ok(None) => break,
            Err(error @ BagError::Damaged { .. }) => {
                damage.add(&error);
                continue;
            }
            Err(error) => return Err(error),
        };
        let Item::Message(message) = item else { continue };
        let channel: &Arc<Channel> = &message.channel;
        match channel.role() {
            Role::Raw => {
                let next = Pending { topic: channel.topic.clone(), row: row(&message) };
                if let Some(Pending { topic, row }) = pending.replace(next) {
                    each(&topic, row)?;
                }
            }
            Role::Beside(raw) => {
                if let Some(Pending { topic, mut row }) = pending.take_if(|pending| pending.topic == raw) {
                    row.header = Header::of(&message);
                    each(&topic, row)?;
                }
            }
            Role::Other => {}
        }
    }
    if let Some(Pending { topic, row }) = pending {
        each(&topic, row)?;
    }
    Ok((damage.into_lines(path), reader.missing_end()))
}

fn row(message: &Message<'_>) -> Row {
    Row {
        log_ns: message.log_ns,
        publish_ns: message.publish_ns,
        header: None,
        payload: message.channel.unsealed(message.data).to_vec(),
    }
}
