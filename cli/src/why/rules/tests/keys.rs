//! Keys that only one of two nodes has, keys of different projects, and revoked keys.

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

/// The blocking steps: name, detail, suggested fix.
fn blocked(facts: &Facts) -> Vec<(String, String, String)> {
    let steps = judge(facts).into_iter().filter(|step| step.state == State::Blocked);
    steps.map(|step| (step.what, step.detail, step.fix.unwrap_or_default())).collect()
}

#[test]
fn keys_on_one_node_only_are_the_cause() {
    for is_hip_secured in [true, false] {
        // Given: a seed names the other node, and no answer has arrived
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
        let (_, detail, fix) =
            told.iter().find(|(what, ..)| what.contains("both have keys")).expect("a step");
        assert!(detail.starts_with(&format!("{secured} has keys, and {other} has none")), "{detail}");
        assert!(fix.contains(&format!("sinew keys issue {other}={address} --keys DIR")), "{fix}");
        assert!(fix.contains("project leg") && fix.contains("security.keys"), "{fix}");
        assert!(told.iter().all(|(.., fix)| !fix.contains("firewall")), "{told:#?}");
    }
}

#[test]
fn equally_secured_nodes_are_fine_and_old_versions_unjudged() {
    let set: [(fn(&mut NodeReport), _); 2] = [(secure, "both have"), (open, "neither has: both are open")];
    for (set, detail) in set {
        let mut facts = free();
        set(hip(&mut facts));
        let has_step =
            |facts: &Facts| judge(facts).into_iter().find(|step| step.what.contains("both have keys"));
        assert_eq!(has_step(&facts), None, "the knee does not say");
        set(knee(&mut facts));
        let step = has_step(&facts).expect("both say");
        assert_eq!((step.state, step.detail.as_str()), (State::Fine, detail));
    }
}

#[test]
fn stream_between_nodes_with_keys_uses_the_connection() {
    // Both report that they have keys, or only one does because the other cannot be queried.
    for reports in [[true, true], [true, false], [false, true]] {
        for is_on in [true, false] {
            // Given
            let mut facts = free();
            facts.streams = [None, None];
            if reports[0] {
                secure(hip(&mut facts));
            }
            if reports[1] {
                secure(knee(&mut facts));
            }
            hip(&mut facts).peers[0].stream = Some(StreamReport { is_on, is_agreed: false, ..values(0) });
            // When
            let steps = judge(&facts);
            // Then
            let what = "class Stream from hip to knee.drive";
            let step = steps.iter().find(|step| step.what == what).expect("it is looked at");
            assert_eq!((step.state, step.fix.as_deref()), (State::Fine, None), "{reports:?}: {step:?}");
            assert_eq!(step.detail, "by the connection (TCP), as nodes with keys do");
        }
    }
    // And: if neither has keys, the fix is the setting
    let mut facts = free();
    open(hip(&mut facts));
    open(knee(&mut facts));
    hip(&mut facts).peers[0].stream = Some(StreamReport { is_agreed: false, ..values(0) });
    let is_setting = |step: &Step| step.fix.as_ref().is_some_and(|fix| fix.contains("`datagrams = true`"));
    assert!(judge(&facts).iter().any(is_setting));
}

#[test]
fn refused_datagrams_are_the_cause_instead_of_a_firewall() {
    let words = "it was not made with this project's keys: an impostor sent it";
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
        assert!(
            told.iter().any(|(_, detail, fix)| detail.contains(words) && fix.contains("sinew keys show"))
        );
        assert!(told.iter().all(|(.., fix)| !fix.contains("firewall")), "{told:#?}");
    }
    // And: refused datagrams of a third node are no cause
    let mut facts = free();
    strangers(&mut facts);
    refuse(hip(&mut facts), "NDL datagram not of this project's keys", "10.0.0.2:70001: it is forged");
    assert!(blocked(&facts).iter().all(|(_, detail, _)| !detail.contains("forged")));
    // And: if the other node cannot be queried, the refused datagrams may be from it
    let mut facts = free();
    never_answered(&mut facts);
    refuse(
        hip(&mut facts),
        "sealed NDL datagram at a node without keys",
        "datagram from 10.0.0.2:7000: it is sealed",
    );
    assert!(
        blocked(&facts).iter().any(|(_, detail, _)| detail.contains("refused a datagram of another node")
            && detail.contains("it is sealed"))
    );
}

/// The hip's last connection attempt to the knee failed with this error.
fn dialled(facts: &mut Facts, fault: &str, error: &str) {
    let peer = &mut hip(facts).peers[0];
    peer.links.clear();
    let (address, error, fault) = ("10.0.0.2:7001".to_owned(), error.to_owned(), fault.to_owned());
    peer.dial = Some(DialReport { address, error, fault, ago_us: 100_000, failed: 5 });
}

#[test]
fn fix_of_a_failed_dial_depends_on_its_progress() {
    const REVOKED: &str = "the certificate of node \"knee\" (10.0.0.2) of project \"leg\", number 7, is revoked; if this is the real one, \
                           `sinew keys issue NODE --keys DIR`, where ca.key is, makes it another";
    for (fault, error, fix) in [
        (
            "not proven",
            REVOKED,
            "TCP reaches 10.0.0.2:7001, and the node there is not authenticated: if this is the real one, `sinew keys issue NODE --keys DIR`",
        ),
        (
            "not proven",
            "the other end does not speak TLS",
            "the node there is not authenticated: the other end does not speak TLS",
        ),
        (
            "hung up",
            "unexpected end of file",
            "TCP reaches 10.0.0.2:7001, and the other end closed the connection",
        ),
        ("refused", "Connection refused (os error 111)", "nothing listens at 10.0.0.2:7001"),
        (
            "system",
            "No route to host (os error 113)",
            "TCP does not reach 10.0.0.2:7001: is there a route (`ip route get 10.0.0.2`)",
        ),
        // A version that reports only the error.
        ("", "Connection refused (os error 111)", "nothing listens at 10.0.0.2:7001"),
        ("", "No route to host (os error 113)", "ip route get 10.0.0.2"),
    ] {
        let mut facts = free();
        dialled(&mut facts, fault, error);
        let told = blocked(&facts);
        let is_it =
            |(_, detail, advice): &(String, String, String)| detail.contains(error) && advice.contains(fix);
        assert!(told.iter().any(is_it), "{fault}: {told:#?}");
    }
    // And: the refusing node reports it, too
    let mut facts = free();
    hip(&mut facts).peers[0].links.clear();
    refuse(knee(&mut facts), "peer not proven", &REVOKED.replace("knee\" (10.0.0.2)", "hip\" (10.0.0.1)"));
    let told = blocked(&facts);
    assert!(
        told.iter().any(|(.., fix)| fix == "if this is the real one, `sinew keys issue NODE --keys DIR`, where ca.key is, makes it another"),
        "{told:#?}"
    );
}
