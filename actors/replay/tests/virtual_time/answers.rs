//! Requests and confirmed messages: answered from the inputs, by an application under test, or by nobody.

use sinew::{
    message::AskError,
    replay::{Flags, compare},
};

use super::*;

payload!("replay.ask" => #[derive(Debug, Clone, Copy)] struct Ask { number: u32 });
payload!("replay.mode", retained => #[derive(Debug, Clone, Copy)] struct Mode { is_walking: bool });
payload!("replay.answer" => #[derive(Debug, Clone, Copy)] struct Answer { number: u32 });

/// Asks the knee each 10 ms, and confirms a note to the motor once.
struct Asker;

impl Asker {
    fn ask(&mut self, number: u32, ctx: &mut AppContext<Self>) {
        let within = Duration::from_millis(15);
        let reply = ctx.message("knee", &Ask { number }).ask::<Answer>(within).unwrap();
        ctx.spawn(reply.into_actor(self).map(move |reply, _, ctx| match reply {
            Ok(answer) => note(ctx, format!("{number}: {}", answer.number)),
            Err(AskError::Deadline(_)) => note(ctx, format!("{number}: no reply")),
            Err(error) => note(ctx, format!("{number}: {error}")),
        }));
    }
}

impl Actor for Asker {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.every(Duration::from_millis(10), |this, tick, ctx| this.ask(tick.number as u32, ctx));
    }
}

struct Knee;

impl Actor for Knee {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Ask>> for Knee {
    type Result = ();

    fn handle(&mut self, ask: Delivery<Ask>, ctx: &mut Self::Context) {
        assert!(ctx.is_wanted(&ask));
        ctx.reply(&ask, &Answer { number: ask.number * 100 }).unwrap();
    }
}

fn wanted<const N: usize>(wanted: [(u64, &str); N]) -> [(Duration, String); N] {
    wanted.map(|(at, text)| (Duration::from_millis(at), text.to_owned()))
}

#[test]
fn recorded_replies_answer_their_requests_at_their_times() {
    let reply = |at, correlation, number| {
        TimedMessage::reply(ms(at), tid(KNEE), tid(HIP), correlation, &Answer { number })
    };
    // The first is of an unknown number, so it answers the oldest; the second request gets none; the third
    // one's number names it.
    let inputs = [reply(12, 77, 7), reply(31, 3, 9)];
    let outputs = replay().app(AppSpec::new("hip", || Asker)).ends_at(ms(39)).run(inputs).unwrap();
    assert_eq!(notes(&outputs), wanted([(12, "1: 7"), (31, "3: 9"), (35, "2: no reply")]));
}

#[test]
fn application_under_test_answers_after_the_latency() {
    let run = |latency| {
        let both =
            replay().app(AppSpec::new("hip", || Asker)).app(AppSpec::new("knee", || Knee).handles::<Ask>());
        notes(&both.latency(latency).ends_at(ms(29)).run([]).unwrap())
    };
    assert_eq!(run(Duration::ZERO), wanted([(10, "1: 100"), (20, "2: 200")]));
    assert_eq!(run(Duration::from_millis(2)), wanted([(14, "1: 100"), (24, "2: 200")]));
}

/// Confirms three notes to the motor.
struct Confirmer;

impl Actor for Confirmer {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        for number in 1..=3 {
            let note_to_motor = Note { text: number.to_string() };
            let outcome = ctx.message("motor", &note_to_motor).confirmed(Duration::from_millis(5)).unwrap();
            ctx.spawn(
                outcome
                    .into_actor(self)
                    .map(move |outcome, _, ctx| note(ctx, format!("{number}: {outcome:?}"))),
            );
        }
    }
}

#[test]
fn recorded_outcomes_settle_confirmed_messages() {
    let outcome = |at, number, outcome| TimedMessage::outcome(ms(at), tid(MOTOR), tid(HIP), number, outcome);
    let inputs = [outcome(1, 2, Outcome::Delivered), outcome(2, 1, Outcome::Expired)];
    let outputs = replay().app(AppSpec::new("hip", || Confirmer)).ends_at(ms(9)).run(inputs).unwrap();
    let to_log: Vec<_> = outputs.iter().filter(|output| output.destination == tid(LOG)).cloned().collect();
    assert_eq!(notes(&to_log), wanted([(1, "2: Delivered"), (2, "1: Expired"), (5, "3: Unknown")]));
}

/// Notes of a flood: many times as many as a mailbox of a replay has room for.
const FLOOD: u32 = 5_000;

/// Sends notes to the knee as fast as it takes them.
struct Flooder;

impl Actor for Flooder {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        let sender = ctx.sender();
        let flood = async move {
            for number in 0..FLOOD {
                let note = Note { text: number.to_string() };
                sender.message(tid(KNEE), &note).room_within(Duration::from_secs(1)).send().await.unwrap();
            }
        };
        ctx.spawn(flood.into_actor(self));
    }
}

/// Takes notes.
struct Reader;

impl Actor for Reader {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Note>> for Reader {
    type Result = ();

    fn handle(&mut self, _: Delivery<Note>, _: &mut Self::Context) {}
}

#[test]
fn flood_waiting_for_room_takes_no_time() {
    let both =
        replay().app(AppSpec::new("hip", || Flooder)).app(AppSpec::new("knee", || Reader).handles::<Note>());
    let outputs = both.ends_at(ms(9)).run([]).unwrap();
    assert!(outputs.iter().map(text).eq((0..FLOOD).map(|number| number.to_string())));
    assert!(
        outputs.iter().all(|output| output.at == outputs[0].at),
        "each wait ends with a wake, not at its deadline"
    );
}

/// Joins a group, and notes the angles there.
struct Member;

impl Actor for Member {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.join("leg");
    }
}

impl Handler<Delivery<Angle>> for Member {
    type Result = ();

    fn handle(&mut self, angle: Delivery<Angle>, ctx: &mut Self::Context) {
        note(ctx, format!("{}", angle.degrees));
    }
}

#[test]
fn group_reaches_its_members_under_test() {
    let member = |name| AppSpec::new(name, || Member).handles::<Angle>();
    let to_group = TimedMessage::of(ms(3), tid(LOG), Tid::group("leg"), &Angle { degrees: 4.0 });
    let to_other = TimedMessage::of(ms(4), tid(LOG), Tid::group("arm"), &Angle { degrees: 5.0 });
    let outputs = replay().app(member("hip")).app(member("knee")).run([to_group, to_other]).unwrap();
    let sources: Vec<_> = outputs.iter().map(|output| output.source).collect();
    assert_eq!(sources, [tid(HIP), tid(KNEE)]);
    assert_eq!(notes(&outputs), wanted([(3, "4"), (3, "4")]));
}

/// Sends a retained mode to a group, and removes it.
struct Announcer;

impl Actor for Announcer {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        // By then the member has joined.
        ctx.run_later(Duration::from_millis(1), |_, ctx| {
            ctx.send(Tid::group("leg"), &Mode { is_walking: true }).unwrap();
            ctx.clear_retained::<Mode>("leg").unwrap();
        });
    }
}

impl Handler<Delivery<Mode>> for Member {
    type Result = ();

    fn handle(&mut self, mode: Delivery<Mode>, ctx: &mut Self::Context) {
        note(ctx, format!("is walking: {}", mode.is_walking));
    }
}

#[test]
fn removal_of_a_retained_value_is_no_message() {
    let run = || {
        let announcer = AppSpec::new("hip", || Announcer);
        let member = AppSpec::new("knee", || Member).handles::<Mode>();
        replay().app(announcer).app(member).ends_at(ms(9)).run([]).unwrap()
    };
    let outputs = run();
    let sent: Vec<_> = outputs.iter().map(|output| (output.source, output.kind)).collect();
    assert_eq!(sent, [(tid(HIP), Mode::KIND), (tid(KNEE), Note::KIND)]);
    assert_eq!(notes(&outputs), wanted([(1, "is walking: true")]));
    // And: a node that had no room for the value has recorded it without KEEP
    let mut recorded = outputs.clone();
    recorded[0].flags = Flags::NONE;
    compare(&recorded, &outputs).expect("the application did the same");
}
