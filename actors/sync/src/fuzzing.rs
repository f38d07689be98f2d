//! Fuzz targets for directory lists and barrier frames.

use sinew_runtime::{fuzzing::is_read_as_written, wire::decode};

use sinew_model::barrier::{ArriveAtBarrier, LeaveBarrier};

use super::{arrivals::Arrivals, list::List};

/// Size limit under which every list fits as a whole.
const ROOM: usize = 1 << 20;

pub fn sent_frames() -> Vec<Vec<u8>> {
    use sinew_runtime::tid::{AppAddress, Incarnation};
    let name = |name: &str| name.to_owned().try_into().expect("it is short");
    let entry = super::list::Entry {
        name: name("knee.drive"),
        app: AppAddress::new(0x8000_0001),
        ready: true,
        ended: None,
        phases: vec![name("calibrated")],
        requires: Vec::new(),
        kinds: Vec::new(),
        handles: Vec::new(),
        sends: Vec::new(),
    };
    let list = List { incarnation: Incarnation(1), version: 2, entries: vec![entry], groups: Vec::new() };
    let arrivals = Arrivals { incarnation: Incarnation(1), version: 2, barriers: Vec::new() };
    vec![list.encode(ROOM).0.to_vec(), arrivals.encode().to_vec()]
}

pub fn frames(bytes: &[u8]) -> bool {
    let list = List::parse(bytes);
    if let Ok(list) = &list {
        let (written, left_out) = list.clone().encode(ROOM);
        assert_eq!(left_out, 0);
        assert_eq!(&List::parse(&written).expect("an encoded value decodes"), list);
    }
    let arrivals = Arrivals::parse(bytes);
    if let Ok(arrivals) = &arrivals {
        assert_eq!(&Arrivals::parse(&arrivals.encode()).expect("an encoded value decodes"), arrivals);
    }
    // These requests come from applications. They are checked when they are executed.
    let asked = decode::<ArriveAtBarrier>(bytes).is_ok() || decode::<LeaveBarrier>(bytes).is_ok();
    is_read_as_written::<List>(bytes) || arrivals.is_ok() || asked
}
