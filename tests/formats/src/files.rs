//! Files written by users and their tools: configurations, keys, recorded trials, topologies.

use std::collections::BTreeMap;

use exoskeleton::robot::topology::Topology;
use exoskeleton_model::{
    datagram::{CommandFrame, Reading},
    gait::trial::Trial,
    joint::Joint,
};
use sinew::{
    AppAddress, NodeAddress, NodeConfig, Tid,
    app::Requirement,
    fault::Fault,
    security::{Certificate, DenyList, DiscoveryKey, Serial, rustls::pki_types::CertificateDer},
};
use sinew_schema::{Comparison, Field, SCHEMA_BYTES_MAX, Schema, Shape, Variant, compare};

/// Maximum length of a text, in bytes. Longer texts only repeat the same structures.
const TEXT_MAX: usize = 16 * 1024;

pub(crate) fn some_configurations() -> Vec<Vec<u8>> {
    let texts = [
        "[node]\nname = 'knee'\naddress = '10.0.0.7'\nproject = 'exo'\npayload_max = 65536\n[lncl]\n[gncl]\nport = 7000\n\
         strangers_max = 16\nhandshake_ms = 100\nfurther = ['10.1.0.7']\n[ndl]\nmulticast = '239.255.1.2:7001'\nperiod_ms = 100\n\
         seeds = ['10.0.0.8:7001']\nmdns_port = false\n[sync]\n[supervision]\n[security]\n",
        "[node]\nname = 'knee'\naddress = '10.0.0.7'\n[ndl]\ninterface = ['eth0/ipv6', 'fe80::7%eth0', 'fd00::7']\nseeds = ['[fe80::8%eth0]:6911', \
         '[fd00::8]:6911']\nmulticast6 = '[ff12::8000:1]:6910'\n",
        "2d6f  # hip\n\nab\n",
        "10.0.0.7/0x80000001",
        "knee.drive within 3s",
        "3 of leg.*",
        "hang(200ms)@5",
        "slow(3ms)@100..200",
        "panic@every(500)",
        "00112233445566778899aabbccddeeff00112233445566778899aabbccddeeff\n",
    ];
    texts.map(|text| text.as_bytes().to_vec()).into()
}

/// A configuration file, a deny list, a key, a fault of `SINEW_FAULTS`, and every address and requirement
/// that occurs in one.
pub(crate) fn configuration(bytes: &[u8]) -> bool {
    let is_key = DiscoveryKey::read(bytes).is_some_and(|key| {
        let again = DiscoveryKey::read(key.text().as_bytes()).expect("what was written can be read");
        assert_eq!(*again.text(), *key.text());
        true
    });
    let Some(text) = std::str::from_utf8(bytes).ok().filter(|text| text.len() <= TEXT_MAX) else {
        return is_key;
    };
    let config = NodeConfig::from_toml(text);
    if let Err(faults) = &config {
        assert!(!faults.to_string().is_empty(), "a refusal has words");
    }
    let denied = DenyList::read(text);
    if let Ok(tid) = text.parse::<Tid>() {
        assert_eq!(tid.to_string().parse::<Tid>().ok(), Some(tid));
    }
    if let Ok(node) = text.parse::<NodeAddress>() {
        assert_eq!(node.to_string().parse::<NodeAddress>().ok(), Some(node));
    }
    let is_serial = text.parse::<Serial>().is_ok_and(|serial| {
        assert_eq!(serial.to_string().parse::<Serial>().as_ref(), Ok(&serial));
        true
    });
    let others = [
        config.is_ok(),
        denied.is_ok(),
        is_serial,
        text.parse::<AppAddress>().is_ok(),
        text.parse::<Requirement>().is_ok(),
        text.parse::<Fault>().is_ok(),
    ];
    is_key || others.contains(&true)
}

pub(crate) fn some_schemas() -> Vec<Vec<u8>> {
    let field = |name: &str, shape, optional| Field { name: name.to_owned(), shape, optional };
    let named = |name: &str| Shape::Named(name.to_owned());
    let walk = Shape::Struct(vec![field("speed", Shape::F32, false)]);
    let variants =
        [("Stand", Shape::Unit), ("Walk", walk), ("Hold", Shape::Newtype(Box::new(named("Degrees"))))];
    let mode = variants.map(|(name, shape)| Variant { name: name.to_owned(), shape });
    let pose = Shape::Struct(vec![
        field("mode", Shape::Option(Box::new(named("Mode"))), true),
        field("legs", Shape::List(Box::new(Shape::Array(Box::new(Shape::F64), 300))), false),
        field(
            "by_joint",
            Shape::Map(Box::new(Shape::Text), Box::new(Shape::Tuple(vec![Shape::U8, Shape::Bytes]))),
            false,
        ),
    ]);
    let types = BTreeMap::from([
        ("Degrees".to_owned(), Shape::Newtype(Box::new(Shape::F32))),
        ("Mode".to_owned(), Shape::Enum(mode.into())),
    ]);
    [Schema { root: pose, types }, Schema { root: Shape::Unit, types: BTreeMap::new() }]
        .map(|schema| schema.encode())
        .into()
}

/// The structure of a payload type: canonical, compared with another one, and listed.
pub(crate) fn schema(bytes: &[u8]) -> bool {
    let schema = match Schema::parse(bytes) {
        Ok(schema) => schema,
        Err(error) => {
            assert!(!error.to_string().is_empty(), "a refusal has words");
            return false;
        }
    };
    assert!(bytes.len() <= SCHEMA_BYTES_MAX && schema.encode() == bytes);
    assert_eq!(compare(&schema, &schema), Comparison::Same);
    assert!(!schema.to_string().is_empty());
    for other in some_schemas() {
        let other = Schema::parse(&other).expect("it was just written");
        let sides = [compare(&schema, &other), compare(&other, &schema)].map(|side| side == Comparison::Same);
        assert_eq!(sides[0], sides[1]);
    }
    true
}

/// A node certificate made by `sinew keys issue`. The copy in the corpus is the same.
pub(crate) fn some_certificates() -> Vec<Vec<u8>> {
    vec![include_bytes!("../../../fuzz/corpus/certificate/seed-node").to_vec()]
}

/// A certificate that a peer presents in the TLS handshake, before anything of it is verified.
pub(crate) fn certificate(der: &[u8]) -> bool {
    let Ok(read) = Certificate::read(CertificateDer::from(der.to_vec())) else { return false };
    let _ = (read.identity(), read.project(), read.validity());
    assert_eq!(read.serial().to_string().parse::<Serial>().as_ref(), Ok(read.serial()));
    true
}

pub(crate) fn some_trials() -> Vec<Vec<u8>> {
    let mut text = "time_s,hip_r_deg,knee_r_deg,ankle_r_deg,grf_v_r,stance_r\n".to_owned();
    // The shortest valid trial: eight strides of half a second, 50 rows per second. Each joint moves as in a
    // walking leg: the hip is flexed at heel strike, the knee peaks at 72 % of the stride, the ankle at 45 %.
    for row in 0..208 {
        let time = f64::from(row) * 0.02;
        let stance = u8::from(row % 25 < 15);
        let wave = |peak: f64| ((2.0 * time - peak) * std::f64::consts::TAU).cos();
        text += &format!(
            "{time:.2},{:.1},{:.1},{:.1},{stance},{stance}\n",
            20.0 * wave(0.0),
            30.0 + 30.0 * wave(0.72),
            10.0 * wave(0.45)
        );
    }
    vec![text.into_bytes()]
}

/// A recorded trial, and the device datagrams that a robot's nodes exchange with a plant.
pub(crate) fn trial(bytes: &[u8]) -> bool {
    if let Ok(command) = CommandFrame::decode(bytes) {
        assert!(CommandFrame::decode(&command.encode()).is_ok());
    }
    if let Ok(reading) = Reading::decode(bytes) {
        assert!(Reading::decode(&reading.encode()).is_ok());
    }
    let Some(text) = std::str::from_utf8(bytes).ok().filter(|text| text.len() <= 4 * TEXT_MAX) else {
        return false;
    };
    let trial = match Trial::parse(text) {
        Ok(trial) => trial,
        Err(error) => {
            assert!(!error.to_string().is_empty(), "a refusal has words");
            return false;
        }
    };
    let strikes = trial.heel_strikes_s();
    assert!(strikes.len() >= 2 && strikes.is_sorted());
    for time in [strikes[0], strikes[strikes.len() - 1], -1e300, 1e300] {
        let (at, duration) = trial.strides_at(time);
        assert!(at.is_finite() && duration.is_finite() && duration > 0.0, "{at} {duration} at {time}");
        let load = trial.vertical_load_bw(time);
        assert!(load.is_finite() && trial.hip_raw_deg(time).is_finite(), "{load} at {time}");
    }
    for joint in Joint::ALL {
        let _ = trial.angle_rad(joint, strikes[0]);
    }
    true
}

pub(crate) fn some_topologies() -> Vec<Vec<u8>> {
    let files = [include_str!("../../../examples/exoskeleton/topology.toml")];
    files.map(|file| file.as_bytes().to_vec()).into()
}

/// The mapping of a robot's nodes to hosts.
pub(crate) fn topology(bytes: &[u8]) -> bool {
    let Some(text) = std::str::from_utf8(bytes).ok().filter(|text| text.len() <= TEXT_MAX) else {
        return false;
    };
    match Topology::parse(text) {
        Ok(read) => {
            let written = read.to_toml();
            assert_eq!(Topology::parse(&written).expect("what was written can be read").to_toml(), written);
            true
        }
        Err(faults) => {
            assert!(!faults.to_string().is_empty(), "a refusal has words");
            false
        }
    }
}
