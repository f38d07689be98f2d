//! Typed payloads of programs in C and C++, which programs in Rust read and write, too.

use sinew::{
    Endpoint, Outcome, Payload as _, Registration, Tid,
    client::LoanedMessage,
    message::{Kind, Rejection},
    payload,
};

use super::{
    Torque,
    ground::{C, C99, CPP, Ground, WATCHDOG, endpoint, is_there},
    resolve,
};

payload!("test.stop" => #[derive(Debug)] struct Stop);
payload!("test.brief_stop" => #[derive(Debug)] struct BriefStop {});
payload!("test.status" => #[derive(Debug)] struct Status { stop: Stop, brief: BriefStop });

#[test]
fn c_reads_and_writes_a_rust_type() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let mut holder = ground.start(&C.shared("tests/programs/holder.c", &ground), &[]);
    holder.wait_for(&["ready"]);
    let mut asking = endpoint(&ground, Registration::new());
    let to = resolve(&mut asking, "holder");
    let doubled: Torque = asking.message(to, &Torque { newton_metres: 2.5 }).ask(WATCHDOG).unwrap();
    assert_eq!(doubled, Torque { newton_metres: 5.0 });
}

/// A payload with these bytes, as from a program in another language.
fn raw(asking: &mut Endpoint, to: Tid, kind: &str, bytes: &[u8]) -> LoanedMessage {
    let mut message = asking.create_message(to, Kind::named(kind), bytes.len()).expect("it is short");
    message.copy_from_slice(bytes);
    message
}

#[test]
fn empty_type_round_trips_in_c99_c11_and_cpp() {
    if !is_there("gcc") || !is_there("g++") {
        return;
    }
    let ground = Ground::new();
    let mut asking = endpoint(&ground, Registration::new().name("asking"));
    for compiler in [C99, C, CPP] {
        let mut stopping = ground.start(&compiler.shared("tests/programs/stop.c", &ground), &[]);
        stopping.wait_for(&["ready"]);
        let to = resolve(&mut asking, "stopping");
        let _: Stop = asking.message(to, &Stop).ask(WATCHDOG).unwrap();
        let _: BriefStop =
            asking.receive(WATCHDOG).unwrap().expect("it expires after a minute").decode().unwrap();
        // As in docs/protocol/frame.md.
        for bytes in [&[][..], &[0x80], &[0x90], &[0xc0]] {
            let message = raw(&mut asking, to, Stop::NAME, bytes);
            let reply = asking.loaned(message).ask_raw(WATCHDOG).unwrap();
            assert_eq!(reply.bytes(), [0x90], "{bytes:?}");
            let brief = asking.receive(WATCHDOG).unwrap().expect("it expires after a minute");
            assert_eq!(brief.kind(), BriefStop::KIND);
        }
        let message = raw(&mut asking, to, Stop::NAME, &[0x07]);
        let outcome = asking.loaned(message).confirmed(WATCHDOG).unwrap();
        assert_eq!(outcome, Outcome::Rejected(Rejection::Malformed));
        stopping.wait_for(&["refused: this is no test.stop: expected a struct, found a number"]);
        asking.send(to, &Torque { newton_metres: 0.0 }).unwrap();
        assert_eq!(stopping.wait_for_exit(), Some(0));
    }
}

#[test]
fn rust_reads_an_empty_field_written_by_c() {
    let ground = Ground::new();
    let mut own = endpoint(&ground, Registration::new());
    let to = own.tid();
    let message = raw(&mut own, to, Status::NAME, b"\x82\xa4stop\x90\xa5brief\x90");
    own.loaned(message).send().unwrap();
    let status: Status = own.receive(WATCHDOG).unwrap().expect("its own message").decode().unwrap();
    let Status { stop: Stop, brief: BriefStop {} } = status;
}

#[test]
fn wrongly_declared_type_does_not_compile() {
    if !is_there("gcc") || !is_there("g++") {
        return;
    }
    let in_c = |declaration: &str| {
        C.refuses(&format!(
            "#include <sinew.h>\nstruct torque {{ float nm; }};\n\
             const sinew_field fields[] = {{ SINEW_FIELD(struct torque, nm) }};\n\
             const sinew_payload_type type = {declaration};\n"
        ))
    };
    let in_cpp = |declaration: &str| {
        CPP.refuses(&format!("#include <sinew.hpp>\nstruct torque {{ float nm; }};\n{declaration}\n"))
    };
    for (errors, words) in [
        (in_c(r#"SINEW_PAYLOAD_EXPIRING("a.b", SINEW_STREAM, 0, struct torque, fields)"#), "TIME_ABOVE_ZERO"),
        (in_c(r#"SINEW_PAYLOAD_EMPTY_EXPIRING("a.b", SINEW_STREAM, 0)"#), "TIME_ABOVE_ZERO"),
        (in_cpp(r#"SINEW_PAYLOAD(torque, "a.b", SINEW_STREAM)"#), "name the fields"),
        (in_cpp("SINEW_STRUCT(torque)"), "name the fields"),
        (
            in_cpp(r#"SINEW_PAYLOAD_EXPIRING(torque, "a.b", SINEW_STREAM, std::chrono::seconds(0), nm)"#),
            "a time to live is above zero",
        ),
    ] {
        assert!(errors.contains(words), "'{words}' is missing:\n{errors}");
    }
}
