//! The records in a chunk.

use std::io::Read as _;

use super::frames::{Body, CHUNK_MAX};

/// Returns the times of the first and the last message that a chunk states, in nanoseconds of the file's wall clock.
pub(super) fn times(chunk: &[u8]) -> Option<(u64, u64)> {
    let mut body = Body(chunk);
    Some((body.u64()?, body.u64()?))
}

/// Decompresses the records of a chunk into `records`, and checks their checksum.
pub(super) fn records(chunk: &[u8], records: &mut Vec<u8>) -> Result<(), String> {
    records.clear();
    let cut = || "it is cut off".to_owned();
    let mut body = Body(chunk);
    // The times of its first and last message: the messages have them, too.
    body.take(16).ok_or_else(cut)?;
    let (size, checksum) = (body.u64().ok_or_else(cut)?, body.u32().ok_or_else(cut)?);
    let compression = body.text().ok_or_else(cut)?;
    let length = body.u64().ok_or_else(cut)?;
    let compressed = body.take(length).ok_or_else(cut)?;
    if size > CHUNK_MAX {
        return Err(format!("it has {size} bytes, at most {CHUNK_MAX} are read"));
    }
    match compression.as_str() {
        "" => records.extend_from_slice(compressed),
        "zstd" => {
            let decoder =
                zstd::stream::read::Decoder::with_buffer(compressed).map_err(|error| error.to_string())?;
            decoder.take(size).read_to_end(records).map_err(|error| error.to_string())?;
        }
        "lz4" => {
            let decoder = lz4::Decoder::new(compressed).map_err(|error| error.to_string())?;
            decoder.take(size).read_to_end(records).map_err(|error| error.to_string())?;
        }
        other => return Err(format!("its compression `{other}` is unknown")),
    }
    if records.len() as u64 != size {
        return Err(format!("it has {} bytes, and states {size}", records.len()));
    }
    let computed = crc32fast::hash(records);
    if checksum != 0 && checksum != computed {
        return Err(format!("its checksum is {computed:08x}, and states {checksum:08x}"));
    }
    Ok(())
}
