//! Parts of this package's tests.

use std::{
    fs,
    path::PathBuf,
    sync::atomic::{AtomicU32, Ordering},
};

use crate::{BagWriter, ChannelId, ChannelInfo, Class, Direction, Party, Record};

/// A folder of one test, which is removed at its end.
pub(crate) struct TestFolder(PathBuf);

impl TestFolder {
    pub(crate) fn new() -> Self {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let folder = std::env::temp_dir().join(format!("sinew-bag-{}-{number}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        Self(folder)
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for TestFolder {
    fn drop(&mut self) {
        // The folder of temporary files is cleared by the system, too.
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// A channel of angles from node 127.0.0.2 to node 127.0.0.3.
pub(crate) fn channel(bag: &mut BagWriter, class: Class, direction: Direction) -> ChannelId {
    typed_channel(bag, class, direction, "exo.angle")
}

/// Same as [`channel`], with this name of the type.
pub(crate) fn typed_channel(
    bag: &mut BagWriter,
    class: Class,
    direction: Direction,
    type_name: &str,
) -> ChannelId {
    with_info(class, direction, type_name, |info| bag.channel(info)).unwrap()
}

/// Calls `act` with the description of such a channel.
pub(crate) fn with_info<R>(
    class: Class,
    direction: Direction,
    type_name: &str,
    act: impl FnOnce(&ChannelInfo<'_>) -> R,
) -> R {
    let party = |tid: u64, node: &str, name: Option<&str>| Party {
        tid,
        text: format!("{node}/1"),
        name: name.map(str::to_owned),
        node: Some(node.to_owned()),
    };
    act(&ChannelInfo {
        source: &party(1, "127.0.0.2", Some("knee.sensor")),
        destination: &party(2, "127.0.0.3", None),
        type_name,
        kind: 7,
        class,
        direction,
        is_protected: false,
        schema: None,
        refused: None,
        seen_before: 0,
    })
}

/// Same as [`channel`], of class Stream.
pub(crate) fn angle(bag: &mut BagWriter, direction: Direction) -> ChannelId {
    channel(bag, Class::Stream, direction)
}

/// A message `{"x": 5}`.
pub(crate) fn record(number: u64, at_ns: u64) -> Record<'static> {
    let (sent_ns, handed_over_ns) = (at_ns, at_ns);
    Record {
        number,
        sequence: number,
        sent_ns,
        handed_over_ns,
        payload: b"\x81\xa1x\x05",
        ..Record::default()
    }
}

/// Returns the place and the length of each chunk of a file.
pub(crate) fn chunks(bytes: &[u8]) -> Vec<(usize, usize)> {
    // The places of all records, without the magic bytes at both ends.
    let (mut at, mut chunks) = (8, Vec::new());
    while at < bytes.len() - 8 {
        let length = u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
        if bytes[at] == 0x06 {
            chunks.push((at, length));
        }
        at += 9 + length;
    }
    chunks
}
