//! Which way values of class Stream go, as either end says it.

use super::*;

fn of_stream(facts: &mut Facts) -> &mut StreamReport {
    hip(facts).peers[0].stream.as_mut().expect("it has a connection of its own")
}

#[test]
fn which_way_stream_goes_is_said_at_both_ends_with_what_lets_datagrams_through() {
    let steps = judge(&free());
    let said =
        |what: &str| steps.iter().find(|step| step.what == what).expect("it is looked at").seen.clone();
    assert_eq!(said("class Stream from hip to knee.drive"), "by datagram (UDP)");
    // Nobody could send one from there.
    assert!(said("class Stream from knee.drive to hip").starts_with("7 values by datagram (UDP) so far"));
    let notes: [(fn(&mut Facts), _, _); 4] = [
        (
            |facts| facts.streams[0] = Some(values(7)),
            "no datagram is answered",
            "UDP through at 10.0.0.2:7001 of knee",
        ),
        (
            |facts| of_stream(facts).is_on = false,
            "switched off here",
            "`datagrams = true` under [gncl] of hip",
        ),
        (
            |facts| of_stream(facts).is_agreed = false,
            "takes no datagrams",
            "`datagrams = true` under [gncl] of knee",
        ),
        (
            |facts| facts.streams[0] = Some(StreamReport { payload_max: Some(872), ..values(8) }),
            "values of up to 872 bytes by datagram (UDP), longer ones by the connection (TCP)",
            "one MTU (`ip link` shows it",
        ),
    ];
    for (change, seen, mend) in notes {
        let mut facts = free();
        change(&mut facts);
        let steps = judge(&facts);
        assert!(steps.iter().all(|step| step.state != State::Blocked), "{steps:#?}");
        let is_it = |step: &&Step| step.state == State::Note && step.seen.contains(seen);
        let note = steps.iter().find(is_it).expect("it is a note");
        assert!(note.mend.as_ref().expect("it can be mended").contains(mend), "{note:?}");
    }
}
