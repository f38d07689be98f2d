//! The records of an MCAP file: each has an opcode, a length and a body.

use std::{
    collections::{BTreeMap, btree_map::Entry},
    io::{self, Read},
    path::{Path, PathBuf},
    sync::Arc,
};

use super::{Channel, MessageSchema};
use crate::error::BagError;

/// Maximum bytes of a record.
pub const RECORD_MAX: u64 = 256 << 20;
/// Maximum bytes of a chunk after decompression.
pub const CHUNK_MAX: u64 = 256 << 20;
/// Maximum bytes of all schemas and channels of a file.
pub(super) const DECLARED_MAX: u64 = 64 << 20;
/// The fault of a schema or a channel that is not kept.
pub(super) const DECLARED_FAULT: &str =
    "a channel or a schema is damaged, or all of them are larger than 64 MiB together";

/// Bytes of opcode and length.
pub(super) const HEAD: usize = 9;
const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";

pub(super) const FOOTER: u8 = 0x02;
pub(super) const SCHEMA: u8 = 0x03;
pub(super) const CHANNEL: u8 = 0x04;
pub(super) const MESSAGE: u8 = 0x05;
pub(super) const CHUNK: u8 = 0x06;
pub(super) const STATISTICS: u8 = 0x0b;
pub(super) const METADATA: u8 = 0x0c;
pub(super) const DATA_END: u8 = 0x0f;

/// The opcode and the place of a record. Its body is in [`Frames::body`].
#[derive(Clone, Copy, Debug)]
pub(super) struct Frame {
    pub(super) opcode: u8,
    pub(super) at: u64,
}

/// Reads record after record.
#[derive(Debug)]
pub(super) struct Frames<R> {
    path: PathBuf,
    source: R,
    at: u64,
    /// The end of the last whole record.
    whole: u64,
    is_over: bool,
    body: Vec<u8>,
}

impl<R: Read> Frames<R> {
    pub(super) fn new(source: R, path: &Path) -> Result<Self, BagError> {
        let mut frames =
            Self { path: path.to_owned(), source, at: 0, whole: 0, is_over: false, body: Vec::new() };
        if !frames.fill(MAGIC.len() as u64)? || frames.body != MAGIC {
            return Err(BagError::Damaged {
                path: path.to_owned(),
                fault: "this is no MCAP file".to_owned(),
                at: 0,
                remedy: "give a file that `sinew record` or another recorder of MCAP wrote",
            });
        }
        frames.whole = frames.at;
        Ok(frames)
    }

    pub(super) const fn position(&self) -> u64 {
        self.at
    }

    pub(super) const fn whole(&self) -> u64 {
        self.whole
    }

    pub(super) fn body(&self) -> &[u8] {
        &self.body
    }

    pub(super) fn damaged(&self, fault: &str) -> BagError {
        let (path, at) = (self.path.clone(), self.whole);
        BagError::Damaged { path, fault: fault.to_owned(), at, remedy: "the reader skips the damaged bytes" }
    }

    /// Reads so many bytes; `false` at the end of the file. The buffer grows with the bytes that are there.
    fn fill(&mut self, length: u64) -> Result<bool, BagError> {
        self.body.clear();
        let read = self.source.by_ref().take(length).read_to_end(&mut self.body);
        let read = read.map_err(|cause: io::Error| BagError::read(&self.path, cause))?;
        self.at += read as u64;
        Ok(read as u64 == length)
    }

    /// Reads the next record; `None` where the file ends, also in the middle of a record.
    pub(super) fn next(&mut self) -> Result<Option<Frame>, BagError> {
        let at = self.at;
        if self.is_over {
            return Ok(None);
        }
        self.whole = at;
        if !self.fill(HEAD as u64)? {
            return Ok(None);
        }
        let mut head = Body(&self.body);
        let (Some(opcode), Some(length)) = (head.u8(), head.u64()) else { return Ok(None) };
        if length > RECORD_MAX {
            // A length that no recorder writes: where the next record begins is unknown.
            self.is_over = true;
            return Err(self.damaged("a record is longer than any recorder writes"));
        }
        if self.fill(length)? {
            return Ok(Some(Frame { opcode, at }));
        }
        if self.body.ends_with(MAGIC) {
            // The file has its end, so it was not cut off in the middle of this record.
            self.is_over = true;
            return Err(self.damaged("the length of a record is damaged"));
        }
        Ok(None)
    }
}

/// Splits the first record from those of a chunk.
pub(super) fn split(records: &[u8]) -> Option<(u8, &[u8])> {
    let mut body = Body(records);
    let (opcode, length) = (body.u8()?, body.u64()?);
    Some((opcode, body.0.get(..usize::try_from(length).ok()?)?))
}

/// Reads a schema or a channel. The first one of a number counts. `declared` is the bytes of all that are kept.
pub(super) fn declare(
    opcode: u8,
    mut body: Body<'_>,
    channels: &mut BTreeMap<u16, Arc<Channel>>,
    schemas: &mut BTreeMap<u16, Arc<MessageSchema>>,
    declared: &mut u64,
) -> Option<()> {
    let id = body.u16()?;
    let grown = declared.saturating_add(body.0.len() as u64);
    let fits = grown <= DECLARED_MAX;
    if opcode == SCHEMA {
        let (name, encoding) = (body.text()?, body.text()?);
        let data = body.bytes()?.to_vec();
        if let Entry::Vacant(place) = schemas.entry(id) {
            if !fits {
                return None;
            }
            place.insert(Arc::new(MessageSchema { name, encoding, data }));
            *declared = grown;
        }
        return Some(());
    }
    let schema = schemas.get(&body.u16()?).cloned();
    let (topic, encoding, metadata) = (body.text()?, body.text()?, body.map()?);
    if let Entry::Vacant(place) = channels.entry(id) {
        if !fits {
            return None;
        }
        place.insert(Arc::new(Channel { id, topic, encoding, schema, metadata }));
        *declared = grown;
    }
    Some(())
}

/// The fields of a record.
#[derive(Clone, Copy, Debug)]
pub(super) struct Body<'b>(pub(super) &'b [u8]);

impl<'b> Body<'b> {
    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (bytes, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*bytes)
    }

    fn u8(&mut self) -> Option<u8> {
        self.array::<1>().map(|[byte]| byte)
    }

    pub(super) fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    pub(super) fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    pub(super) fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    pub(super) fn take(&mut self, length: u64) -> Option<&'b [u8]> {
        let (bytes, rest) = self.0.split_at_checked(usize::try_from(length).ok()?)?;
        self.0 = rest;
        Some(bytes)
    }

    /// Bytes behind their length.
    pub(super) fn bytes(&mut self) -> Option<&'b [u8]> {
        let length = self.u32()?;
        self.take(length.into())
    }

    pub(super) fn text(&mut self) -> Option<String> {
        Some(std::str::from_utf8(self.bytes()?).ok()?.to_owned())
    }

    /// Keys and values, behind the length of all.
    pub(super) fn map(&mut self) -> Option<BTreeMap<String, String>> {
        let (mut inner, mut all) = (Self(self.bytes()?), BTreeMap::new());
        while !inner.0.is_empty() {
            let key = inner.text()?;
            all.insert(key, inner.text()?);
        }
        Some(all)
    }
}

/// Reads the body of the record at which the file stands, if it is whole and a chunk.
pub(super) fn at(source: &mut impl Read, path: &Path) -> Result<Option<Vec<u8>>, BagError> {
    let (path, body) = (path.to_owned(), Vec::new());
    let mut frames = Frames { path, source, at: 0, whole: 0, is_over: false, body };
    let frame = frames.next()?;
    Ok(frame.filter(|frame| frame.opcode == CHUNK).map(|_| frames.body))
}

/// Returns the time of a record that is a message.
pub(super) fn log_time(opcode: u8, body: &[u8]) -> Option<u64> {
    let mut body = Body(body);
    // Channel and sequence come before it.
    body.take(6)?;
    body.u64().filter(|_| opcode == MESSAGE)
}
