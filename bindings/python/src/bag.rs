//! Files of recordings for Python: their channels, and their payloads.

use std::{
    collections::BTreeMap,
    fs::File,
    io::BufReader,
    path::PathBuf,
    sync::{Mutex, MutexGuard, PoisonError},
};

use pyo3::{
    prelude::*,
    types::{PyBytes, PyList},
};
use sinew_bag::{
    BagError,
    read::{Item, Reader, Role},
};

use crate::errors;

/// A channel: its number, its topic, its encoding, and the metadata.
type ChannelTuple = (u16, String, String, BTreeMap<String, String>);

/// Reads the payloads of a recording, in the order of the file.
#[pyclass(frozen, module = "sinew._sinew")]
pub(crate) struct BagReader {
    reader: Mutex<Reader<BufReader<File>>>,
    /// The records that could not be read.
    damage: Mutex<Vec<String>>,
}

/// Maximum number of lines about damaged records that are kept.
const DAMAGE_MAX: usize = 1_000;

/// A payload, before Python has its bytes.
struct Payload {
    channel: u16,
    log_ns: u64,
    publish_ns: u64,
    sequence: u32,
    data: Vec<u8>,
}

impl BagReader {
    fn reader(&self) -> MutexGuard<'_, Reader<BufReader<File>>> {
        self.reader.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reads up to this many payloads. Payloads of other programs' channels are read as they are.
    fn read(&self, count: usize) -> Result<Vec<Payload>, BagError> {
        let mut found = Vec::new();
        let mut reader = self.reader();
        while found.len() < count {
            match reader.next_item() {
                Ok(None) => break,
                Ok(Some(Item::Message(message))) => {
                    if matches!(message.channel.role(), Role::Beside(_)) {
                        continue;
                    }
                    found.push(Payload {
                        channel: message.channel.id,
                        log_ns: message.log_ns,
                        publish_ns: message.publish_ns,
                        sequence: message.sequence,
                        data: message.channel.unsealed(message.data).to_vec(),
                    });
                }
                Ok(Some(Item::Metadata(..))) => {}
                Err(error @ BagError::Damaged { .. }) => self.note(&error),
                Err(error) => return Err(error),
            }
        }
        Ok(found)
    }

    fn note(&self, error: &BagError) {
        let mut damage = self.damage.lock().unwrap_or_else(PoisonError::into_inner);
        if damage.len() < DAMAGE_MAX {
            damage.push(error.to_string());
        }
    }
}

#[pymethods]
impl BagReader {
    #[new]
    fn open(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let reader = py.detach(|| Reader::open(path)).map_err(|error| errors::bag(py, &error))?;
        Ok(Self { reader: Mutex::new(reader), damage: Mutex::default() })
    }

    /// Returns the next payloads, at most `count`: channel, time of arrival and of sending in nanoseconds of the file's
    /// wall clock, sequence, bytes. An empty list is the end.
    fn next<'py>(&self, py: Python<'py>, count: usize) -> PyResult<Bound<'py, PyList>> {
        let read = py.detach(|| self.read(count)).map_err(|error| errors::bag(py, &error))?;
        let list = PyList::empty(py);
        for Payload { channel, log_ns, publish_ns, sequence, data } in read {
            list.append((channel, log_ns, publish_ns, sequence, PyBytes::new(py, &data)))?;
        }
        Ok(list)
    }

    /// Returns the channels that were read so far.
    fn channels(&self) -> Vec<ChannelTuple> {
        let reader = self.reader();
        let channels = reader.channels().values();
        channels
            .map(|channel| {
                (channel.id, channel.topic.clone(), channel.encoding.clone(), channel.metadata.clone())
            })
            .collect()
    }

    /// Returns a line for each damaged record that was skipped so far, and one about a missing end.
    fn damage(&self) -> Vec<String> {
        let missing_end = self.reader().missing_end();
        let damage = self.damage.lock().unwrap_or_else(PoisonError::into_inner);
        damage.iter().cloned().chain(missing_end).collect()
    }
}
