//! Two nodes on virtual time. The network between them loses, duplicates, delays and blocks datagrams, as a seed
//! decides. Meanwhile the layer is restarted at either side, the connection is full, and the receiver forgets the
//! sender. Planted faults must be found.

mod world;

use std::time::Duration;

use sinew_gncl::datagrams::{DATAGRAM_MAX, Report, SHORTEST};
use sinew_sim::{Chance, Hunt, Quality, Seeds};

use self::world::World;

const SEEDS: Seeds = Seeds {
    variable: "SINEW_GNCL_SEED",
    package: "sinew-gncl",
    target: "--test simulation",
    test: "values_arrive_once",
    count: 60,
};

/// Returns a network that loses `lost_per_mille` of 1,000 datagrams. Delays of up to `jitter_us` more than `delay_us`
/// let datagrams overtake each other.
fn quality(lost_per_mille: u64, delay_us: u64, jitter_us: u64) -> Quality {
    let delay_min = Duration::from_micros(delay_us);
    let delay_max = delay_min + Duration::from_micros(jitter_us);
    Quality { lost_per_mille, delay_min, delay_max, ..Quality::GOOD }
}

/// The planted fault.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Planted {
    #[default]
    Nothing,
    /// Each value is forwarded, with any number.
    NumbersNotCompared,
    /// A value that counts as lost is not sent again.
    NotRepeated,
    /// A restart of the sender's layer restarts its numbers.
    NumbersNotKept,
    /// A restart of the receiver's layer forgets the received numbers.
    ReceivedNumbersNotKept,
    /// When datagrams do not get through, values in flight are not handed to the connection.
    NotOffered,
    /// The numbers of values by the connection are not compared.
    ConnectionNotCompared,
    /// Values that find no room in the connection are dropped.
    FullDrops,
    /// The last accepted value is discarded for a newer one before the connection has accepted that.
    DroppedTooEarly,
    /// Values in flight are dropped when the peer announces another key.
    NewKeyDrops,
    /// An answered probe counts for every length.
    AllLengthsTrusted,
}

/// Runs two seconds of up to six flows with all events of a seed, then quiet.
fn play(seed: u64, planted: Planted) -> Result<World, String> {
    let mut chance = Chance::new(seed ^ 0x5eed);
    let (lost, delay) = (chance.of(&[0, 10, 50, 300]), chance.of(&[100, 2_000, 20_000]));
    let network = quality(lost, delay, chance.of(&[0, 500, 30_000]));
    let network = Quality { doubled_per_mille: chance.of(&[0, 100]), ..network };
    let mut world = World::new(seed, network, planted);
    // From 100 to 1,175 bytes.
    world.lengths = |key| 100 + 215 * usize::from(key);
    let flows = 1 + chance.below(6);
    let (ends_cut_off, ends_forgotten) = (chance.below(3) == 0, chance.below(3) == 0);
    for millis in 0..2_000 {
        for key in 0..flows {
            // Some flows send each millisecond, some seldom: superseded values are not repeated, others must be.
            if chance.below(1 + 20 * key) == 0 {
                world.send(key as u8);
            }
        }
        match chance.below(1_000) {
            0..=2 => world.restart_sender(),
            3..=5 => world.restart_receiver(),
            6 => world.block(true),
            7..=9 => world.block(false),
            10 => world.sender.reconnected(world.now),
            11..=12 => world.is_full = true,
            13..=17 => world.is_full = false,
            18..=19 => world.forget_sender(),
            20 => world.longest = SHORTEST + chance.below(1_061) as usize,
            21 => world.longest = DATAGRAM_MAX,
            _ => {}
        }
        if ends_cut_off && millis > 1_200 {
            world.block(true);
            world.is_full = true;
        }
        world.steps(1);
    }
    if ends_forgotten {
        world.forget_sender();
    }
    world.heal(Quality { lost_per_mille: network.lost_per_mille.min(50), ..network });
    world.block(chance.below(4) == 0);
    world.is_full = false;
    world.steps(3_000);
    world.verdict()?;
    Ok(world)
}

#[test]
fn values_arrive_once_in_order_on_any_network() {
    let (mut datagrams, mut connection) = (0, 0);
    SEEDS.run(|seed, _| {
        let world = play(seed, Planted::Nothing)?;
        datagrams += world.by_datagram;
        connection += world.by_connection;
        Ok(())
    });
    assert!(
        SEEDS.only().is_some() || datagrams > 3 * connection && connection > 100,
        "{datagrams} by datagram, {connection} otherwise"
    );
}

#[test]
fn each_planted_fault_of_the_datagrams_is_found() {
    let faults = [
        Planted::NumbersNotCompared,
        Planted::NotRepeated,
        Planted::NumbersNotKept,
        Planted::ReceivedNumbersNotKept,
        Planted::NotOffered,
        Planted::ConnectionNotCompared,
        Planted::FullDrops,
        Planted::DroppedTooEarly,
        Planted::NewKeyDrops,
    ];
    let hunt = Hunt { seeds: &SEEDS, faults: &faults, within: 120, found_last: &[] };
    hunt.run(|seed, planted, _| play(seed, planted.unwrap_or_default()).map(drop));
}

#[test]
fn datagram_loss_delays_values_by_milliseconds_only() {
    for (lost, p99_max_us) in [(0, 1_000), (10, 6_000), (50, 14_000)] {
        let network = quality(lost, 300, 100);
        let mut world = World::new(7, network, Planted::Nothing);
        world.steps(100);
        for _ in 0..2_000 {
            // A value that is not superseded for long, so a loss has to be repaired.
            world.send(0);
            world.steps(10);
        }
        world.verdict().unwrap();
        world.ages_us.sort_unstable();
        let p99 = world.ages_us[world.ages_us.len() * 99 / 100];
        assert!(p99 <= p99_max_us, "{lost}: p99 {p99} us");
        assert_eq!(world.by_connection, 0);
    }
}

#[test]
fn acknowledgement_that_waits_causes_no_repetition() {
    let mut world = World::new(9, quality(0, 300, 100), Planted::Nothing);
    world.steps(100);
    // The values of the later pauses are not superseded before their time-out.
    for pause in [1, 2, 5, 10] {
        for _ in 0..100 {
            world.send(0);
            world.steps(pause);
        }
    }
    assert_eq!((world.by_datagram, world.transmissions), (400, 400));
    world.verdict().unwrap();
}

#[test]
fn blocked_path_is_detected_without_loss_and_retried() {
    let network = quality(0, 300, 0);
    let mut world = World::new(1, network, Planted::Nothing);
    world.steps(100);
    world.send(0);
    world.steps(100);
    assert_eq!((world.by_datagram, world.by_connection), (1, 0));
    world.block(true);
    world.send(0);
    world.steps(1_000);
    assert!(!world.sender.is_open());
    world.send(0);
    world.steps(5_000);
    assert_eq!(world.came[&0], [1, 2, 3]);
    assert_eq!(world.warnings, 1);
    world.block(false);
    world.steps(10_000);
    world.send(0);
    world.steps(100);
    assert!(world.sender.is_open());
    assert_eq!((world.came[&0].len(), world.by_datagram), (4, 3));
    world.verdict().unwrap();
}

/// The lengths in turn, from 120 bytes to a whole datagram.
const LENGTHS: [usize; 6] = [120, 488, 788, 988, 1_188, DATAGRAM_MAX];

/// Sends values of each length 50 times a second, for this time. Returns the numbers of received values per length.
fn send_each_length(world: &mut World, millis: u64) -> Vec<usize> {
    let before: Vec<_> = (0..6).map(|key| world.came.get(&key).map_or(0, Vec::len)).collect();
    for _ in 0..millis / 20 {
        (0..6).for_each(|key| world.send(key));
        world.steps(20);
    }
    world.steps(250);
    (0..6).map(|key| world.came.get(&key).map_or(0, Vec::len) - before[usize::from(key)]).collect()
}

/// Returns the received values per length in 5 s, of 250 each, on a path that drops datagrams longer than `longest`
/// from the start.
fn behind_a_hole(longest: usize, planted: Planted) -> (Vec<usize>, World) {
    let network = quality(0, 300, 100);
    let mut world = World::new(3, network, planted);
    (world.longest, world.lengths) = (longest, |key| LENGTHS[usize::from(key)]);
    world.steps(1_000);
    (send_each_length(&mut world, 5_000), world)
}

// spec: DATAGRAM-7
#[test]
fn every_length_arrives_where_long_datagrams_vanish() {
    for longest in [300, 600, 972, 1_199] {
        let (came, mut world) = behind_a_hole(longest, Planted::Nothing);
        assert_eq!(came, [250; 6], "longer than {longest} vanish");
        let report = world.sender.report();
        assert!(matches!(report, Some(Report::Narrow(passes)) if passes <= longest), "{report:?}");
        world.verdict().unwrap();
        let (came, _) = behind_a_hole(longest, Planted::AllLengthsTrusted);
        assert!(came[5] < 10, "a probe that is believed for every length is found: {came:?}");
    }
}

// spec: DATAGRAM-7
#[test]
fn shrinking_path_costs_few_values_and_recovers() {
    let network = quality(10, 300, 100);
    let mut world = World::new(5, network, Planted::Nothing);
    world.lengths = |key| LENGTHS[usize::from(key)];
    world.steps(100);
    assert_eq!(send_each_length(&mut world, 1_000), [50; 6]);
    world.longest = 700;
    let came = send_each_length(&mut world, 2_000);
    assert!(came.iter().all(|count| (95..=100).contains(count)), "{came:?}");
    let by_connection = world.by_connection;
    assert_eq!(send_each_length(&mut world, 2_000), [100; 6]);
    assert!(world.by_connection > by_connection);
    world.longest = DATAGRAM_MAX;
    world.steps(11_000);
    let by_connection = world.by_connection;
    assert_eq!(send_each_length(&mut world, 1_000), [50; 6]);
    assert_eq!(world.by_connection, by_connection, "all go by datagram again");
    world.verdict().unwrap();
}
