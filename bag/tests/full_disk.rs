//! A disk that is full in the middle of a recording, and has room again later.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use sinew_bag::{
    BagError, BagWriter, ChannelInfo, Class, Compression, Direction, Options, Origin, Party, Record, check,
    read::{Item, Reader, Role},
};

const SECOND: u64 = 1_000_000_000;

/// A file system of 1 MiB in memory, until the end of the test.
struct SmallDisk(PathBuf);

impl SmallDisk {
    fn mount() -> Result<Self, String> {
        let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("small-disk-{}", std::process::id()));
        fs::create_dir_all(&path).map_err(|error| error.to_string())?;
        let mut mount = Command::new("mount");
        let output = mount.args(["-t", "tmpfs", "-o", "size=1m", "tmpfs"]).arg(&path).output();
        let output = output.map_err(|error| format!("mount: {error}"))?;
        let disk = Self(path);
        if output.status.success() {
            Ok(disk)
        } else {
            Err(String::from_utf8_lossy(&output.stderr).into_owned())
        }
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // Where it was not mounted there is nothing to unmount, and the folder is empty.
        let _ = Command::new("umount").arg(&self.0).output();
        let _ = fs::remove_dir(&self.0);
    }
}

/// Returns the payloads in a file, and whether all of it can be read.
fn payloads(path: &Path) -> (u64, bool) {
    let mut reader = Reader::open(path).expect("it can be opened");
    let (mut count, mut is_whole) = (0, true);
    loop {
        match reader.next_item() {
            Ok(Some(Item::Message(message))) => count += u64::from(message.channel.role() == Role::Raw),
            Ok(Some(Item::Metadata(..))) => {}
            Ok(None) => return (count, is_whole),
            Err(_) => is_whole = false,
        }
    }
}

#[test]
fn full_disk_is_reported_once_and_new_part_follows() {
    let disk = match SmallDisk::mount() {
        Ok(disk) => disk,
        Err(reason) => {
            println!("skipped: no file system can be mounted: {}", reason.trim());
            return;
        }
    };
    let (filler, path) = (disk.0.join("filler"), disk.0.join("walk.mcap"));
    fs::write(&filler, vec![0; 512 << 10]).expect("there is room for it");
    let options = Options { compression: Compression::None, chunk_bytes: 64 << 10, ..Options::default() };
    let mut bag = BagWriter::create(&path, options, Origin::default()).expect("there is room");
    let party = Party { tid: 1, text: "127.0.0.2/1".into(), ..Party::default() };
    let channel = bag.channel(&ChannelInfo {
        source: &party,
        destination: &party,
        type_name: "demo.scan",
        kind: 7,
        class: Class::Bulk,
        direction: Direction::Sent,
        is_protected: false,
        schema: None,
        refused: None,
        seen_before: 0,
    });
    let channel = channel.expect("it is the first one");
    // 4 KiB of bytes, which stand in the view, too.
    let payload = [&[0xc5, 0x10, 0x00][..], &[7; 4_096]].concat();
    let mut faults = Vec::new();
    for number in 1..=140 {
        // The disk has room again from the hundredth message on.
        if number == 100 {
            fs::remove_file(&filler).expect("it is there");
        }
        let at_ns = number * SECOND / 20;
        let record = Record {
            number,
            sequence: number,
            sent_ns: at_ns,
            handed_over_ns: at_ns,
            payload: &payload,
            ..Record::default()
        };
        faults.extend(bag.message(channel, &record).err());
    }
    let totals = bag.finish(8 * SECOND).expect("there is room");
    assert!(matches!(faults[..], [BagError::Write { .. }]), "{faults:?}");
    assert!(faults[0].to_string().contains("free space on this disk"), "{}", faults[0]);
    assert!(totals.written > 0 && totals.dropped > 0 && totals.seen == 140, "{totals:?}");
    assert_eq!((totals.written + totals.dropped, totals.parts), (140, 2), "{totals:?}");
    let parts = [path.clone(), disk.0.join("walk.1.mcap")];
    let [(first, first_is_whole), (second, second_is_whole)] =
        [&parts[0], &parts[1]].map(|path| payloads(path));
    assert!(first_is_whole && second_is_whole && first > 0 && second > 0);
    assert_eq!(first + second, totals.written);
    assert_eq!(check(&parts).expect("they can be read").findings, []);
}
