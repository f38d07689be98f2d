//! The transport for values of class Stream, as reported by either end.

use super::*;

fn of_stream(facts: &mut Facts) -> &mut StreamReport {
    hip(facts).peers[0].stream.as_mut().expect("it has a connection of its own")
}

#[test]
fn stream_transport_is_reported_at_both_ends() {
    let steps = judge(&free());
    let detail =
        |what: &str| steps.iter().find(|step| step.what == what).expect("it is looked at").detail.clone();
    assert_eq!(detail("class Stream from hip to knee.drive"), "by datagram (UDP)");
    // No value could be sent from there.
    assert!(detail("class Stream from knee.drive to hip").starts_with("7 values by datagram (UDP) so far"));
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
    for (change, detail, fix) in notes {
        let mut facts = free();
        change(&mut facts);
        let steps = judge(&facts);
        assert!(steps.iter().all(|step| step.state != State::Blocked), "{steps:#?}");
        let is_it = |step: &&Step| step.state == State::Note && step.detail.contains(detail);
        let note = steps.iter().find(is_it).expect("it is a note");
        assert!(note.fix.as_ref().expect("it has a fix").contains(fix), "{note:?}");
    }
}
