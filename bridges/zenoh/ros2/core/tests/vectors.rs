//! Hashes and bytes of another implementation, `rosbags` 0.11.9 of PyPI. Those of messages are, except that of
//! `ServiceEventInfo`, also those of its own definitions of ROS 2 Jazzy.

use sinew_ros2_core::{Catalog, decode, encode, type_hash};

const VECTORS: &str = include_str!("vectors.txt");

fn bytes(digits: &str) -> Vec<u8> {
    let pair = |at| u8::from_str_radix(&digits[at..at + 2], 16).expect("two digits");
    (0..digits.len()).step_by(2).map(pair).collect()
}

fn lines(fields: usize) -> impl Iterator<Item = Vec<&'static str>> {
    let lines = VECTORS.lines().filter(|line| !line.starts_with('#'));
    lines.map(|line| line.split(' ').collect::<Vec<_>>()).filter(move |parts| parts.len() == fields)
}

#[test]
fn hashes_are_those_of_another_implementation() {
    let catalog = Catalog::shipped();
    let mut count = 0;
    for line in lines(2) {
        let name = line[0];
        let hash = if name.contains("/srv/") {
            type_hash(&catalog.service(name).expect("a service").description)
        } else {
            type_hash(&catalog.message(name).expect("a message"))
        };
        assert_eq!(hash, line[1], "{name}");
        count += 1;
    }
    assert_eq!(count, 30);
}

#[test]
fn bytes_are_those_of_another_implementation() {
    let catalog = Catalog::shipped();
    let mut count = 0;
    for line in lines(3) {
        let of = catalog.message(line[0]).expect("a message");
        let (little, big) = (bytes(line[1]), bytes(line[2]));
        let value = decode(&of, &little).expect(line[0]);
        assert_eq!(encode(&of, &value), Ok(little), "{}", line[0]);
        assert_eq!(decode(&of, &big), Ok(value), "{}", line[0]);
        count += 1;
    }
    assert_eq!(count, 11);
}
