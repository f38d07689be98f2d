//! Keys that one of two nodes has and the other has not, that are not of one project, or that are revoked.

use sinew::inspect::{CertificateReport, SecurityReport};

use super::*;

fn secure(report: &mut NodeReport) {
    let certificate = CertificateReport {
        from_s: 1,
        until_s: 3,
        clock_s: 2,
        times: "strict".to_owned(),
        is_revoked: false,
    };
    report.security = Some(SecurityReport { is_beyond_host: true, certificate: Some(certificate) });
}

fn open(report: &mut NodeReport) {
    report.security = Some(SecurityReport { is_beyond_host: true, certificate: None });
}

fn refuse(report: &mut NodeReport, cause: &str, detail: &str) {
    let (cause, detail) = (cause.to_owned(), detail.to_owned());
    report.refusals.push(RefusalReport { cause, count: 3, detail, ago_us: 1_000_000 });
}

/// The steps in the way: what, what is seen, what mends it.
fn blocked(facts: &Facts) -> Vec<(String, String, String)> {
    let steps = judge(facts).into_iter().filter(|step| step.state == State::Blocked);
    steps.map(|step| (step.what, step.seen, step.mend.unwrap_or_default())).collect()
}

#[test]
fn nodes_of_which_one_has_keys_are_told_so_with_the_command_and_no_firewall_is_blamed() {
    for is_hip_secured in [true, false] {
        // Given: a seed names it, and no answer has come
        let mut facts = free();
        strangers(&mut facts);
        hip(&mut facts).seeds.push("10.0.0.2:7000".to_owned());
        if is_hip_secured {
            secure(hip(&mut facts));
            open(knee(&mut facts));
        } else {
            open(hip(&mut facts));
            secure(knee(&mut facts));
        }
        // When
        let told = blocked(&facts);
        // Then
        let (secured, other, address) =
            if is_hip_secured { ("hip", "knee", "10.0.0.2") } else { ("knee", "hip", "10.0.0.1") };
        let (_, seen, mend) = told.iter().find(|(what, ..)| what.contains("both have keys")).expect("a step");
        assert!(seen.starts_with(&format!("{secured} has keys, and {other} has none")), "{seen}");
        assert!(mend.contains(&format!("sinew keys issue {other}={address} --keys DIR")), "{mend}");
        assert!(mend.contains("project leg") && mend.contains("security.keys"), "{mend}");
        assert!(told.iter().all(|(.., mend)| !mend.contains("firewall")), "{told:#?}");
    }
}

#[test]
fn nodes_that_both_have_keys_or_neither_are_fine_and_of_an_older_version_nothing_is_said() {
    let set: [(fn(&mut NodeReport), _); 2] = [(secure, "both have"), (open, "neither has: both are open")];
    for (set, seen) in set {
        let mut facts = free();
        set(hip(&mut facts));
        let has_step =
            |facts: &Facts| judge(facts).into_iter().find(|step| step.what.contains("both have keys"));
        assert_eq!(has_step(&facts), None, "the knee does not say");
        set(knee(&mut facts));
        let step = has_step(&facts).expect("both say");
        assert_eq!((step.state, step.seen.as_str()), (State::Fine, seen));
    }
}

#[test]
fn between_nodes_with_keys_stream_goes_by_the_connection_and_no_setting_is_blamed() {
    // Both say that they have keys, or one alone, as the other one cannot be asked.
    for who_says in [[true, true], [true, false], [false, true]] {
        for is_on in [true, false] {
            // Given
            let mut facts = free();
            facts.streams = [None, None];
            if who_says[0] {
                secure(hip(&mut facts));
            }
            if who_says[1] {
                secure(knee(&mut facts));
            }
            hip(&mut facts).peers[0].stream = Some(StreamReport { is_on, is_agreed: false, ..values(0) });
            // When
            let steps = judge(&facts);
            // Then
            let what = "class Stream from hip to knee.drive";
            let step = steps.iter().find(|step| step.what == what).expect("it is looked at");
            assert_eq!((step.state, step.mend.as_deref()), (State::Fine, None), "{who_says:?}: {step:?}");
            assert_eq!(step.seen, "by the connection (TCP), as nodes with keys do");
        }
    }
    // And: where neither has keys the setting is what is to be looked at
    let mut facts = free();
    open(hip(&mut facts));
    open(knee(&mut facts));
    hip(&mut facts).peers[0].stream = Some(StreamReport { is_agreed: false, ..values(0) });
    let is_setting = |step: &Step| step.mend.as_ref().is_some_and(|mend| mend.contains("`datagrams = true`"));
    assert!(judge(&facts).iter().any(is_setting));
}

#[test]
fn datagrams_that_are_refused_for_their_keys_are_the_reason_and_not_a_firewall() {
    let words = "it was not made with this project's keys: somebody pretends";
    for is_refused_by_hip in [true, false] {
        let mut facts = free();
        strangers(&mut facts);
        hip(&mut facts).seeds.push("10.0.0.2:7000".to_owned());
        let (by, from) = if is_refused_by_hip {
            (hip(&mut facts), "10.0.0.2:7000")
        } else {
            (knee(&mut facts), "10.0.0.1:7000")
        };
        refuse(by, "NDL datagram not of this project's keys", &format!("{from}: {words}"));
        let told = blocked(&facts);
        assert!(told.iter().any(|(_, seen, mend)| seen.contains(words) && mend.contains("sinew keys show")));
        assert!(told.iter().all(|(.., mend)| !mend.contains("firewall")), "{told:#?}");
    }
    // And: those of a third one are no reason
    let mut facts = free();
    strangers(&mut facts);
    refuse(hip(&mut facts), "NDL datagram not of this project's keys", "10.0.0.2:70001: it is forged");
    assert!(blocked(&facts).iter().all(|(_, seen, _)| !seen.contains("forged")));
    // And: where the other cannot be asked it may be its
    let mut facts = free();
    never_answered(&mut facts);
    refuse(
        hip(&mut facts),
        "sealed NDL datagram at a node without keys",
        "datagram from 10.0.0.2:7000: it is sealed",
    );
    assert!(
        blocked(&facts)
            .iter()
            .any(|(_, seen, _)| seen.contains("refused somebody's") && seen.contains("it is sealed"))
    );
}

/// The hip's last dial of the knee failed so.
fn dialled(facts: &mut Facts, fault: &str, error: &str) {
    let peer = &mut hip(facts).peers[0];
    peer.links.clear();
    let (address, error, fault) = ("10.0.0.2:7001".to_owned(), error.to_owned(), fault.to_owned());
    peer.dial = Some(DialReport { address, error, fault, ago_us: 100_000, failed: 5 });
}

#[test]
fn what_mends_a_dial_depends_on_how_far_it_came_and_of_a_revoked_certificate_the_fault_says_it_itself() {
    const REVOKED: &str = "the certificate of node \"knee\" (10.0.0.2) of project \"leg\", number 7, is revoked; if this is the real one, \
                           `sinew keys issue NODE --keys DIR`, where ca.key is, makes it another";
    for (fault, error, mend) in [
        (
            "not proven",
            REVOKED,
            "TCP reaches 10.0.0.2:7001, and it is not proven who is there: if this is the real one, `sinew keys issue NODE --keys DIR`",
        ),
        (
            "not proven",
            "the other end does not speak TLS",
            "not proven who is there: the other end does not speak TLS",
        ),
        ("hung up", "unexpected end of file", "TCP reaches 10.0.0.2:7001, and whoever is there hung up"),
        ("refused", "Connection refused (os error 111)", "nobody listens at 10.0.0.2:7001"),
        (
            "system",
            "No route to host (os error 113)",
            "TCP does not reach 10.0.0.2:7001: is there a route (`ip route get 10.0.0.2`)",
        ),
        // Of a version that says the error alone.
        ("", "Connection refused (os error 111)", "nobody listens at 10.0.0.2:7001"),
        ("", "No route to host (os error 113)", "ip route get 10.0.0.2"),
    ] {
        let mut facts = free();
        dialled(&mut facts, fault, error);
        let told = blocked(&facts);
        let is_it = |(_, seen, said): &(String, String, String)| seen.contains(error) && said.contains(mend);
        assert!(told.iter().any(is_it), "{fault}: {told:#?}");
    }
    // And: who was dialled and refuses says it, too
    let mut facts = free();
    hip(&mut facts).peers[0].links.clear();
    refuse(knee(&mut facts), "peer not proven", &REVOKED.replace("knee\" (10.0.0.2)", "hip\" (10.0.0.1)"));
    let told = blocked(&facts);
    assert!(
        told.iter().any(|(.., mend)| mend == "if this is the real one, `sinew keys issue NODE --keys DIR`, where ca.key is, makes it another"),
        "{told:#?}"
    );
}
