use std::sync::mpsc::{Receiver as Taken, RecvTimeoutError, SyncSender, sync_channel};

use serde_json::{Value, json};
use sinew::{
    parameters::{ParameterOutcome, SetParameters},
    stop::StopReport,
};

use super::*;
use crate::{
    snapshot::Snapshot,
    source::{AppParameters, LiveChannel, NoSystem, Tap},
    stop::StopAct,
};

const TOPIC: &str = "/hip/exo.angle/view";
/// The watchdog of a test that waits.
const WATCHDOG: Duration = Duration::from_secs(60);

fn hub() -> Hub {
    Hub { shared: Arc::default(), session: "1".into() }
}

fn channel_of(topic: &str, schema: &[u8]) -> LiveItem<'static> {
    let channel = LiveChannel { topic: topic.to_owned(), schema: schema.to_vec(), ..LiveChannel::default() };
    LiveItem::Channel(channel)
}

/// Hands over an item, and ends the look.
fn take(hub: &Hub, item: LiveItem<'_>) {
    let mut state = hub.shared.lock();
    state.take(item);
    state.announce();
}

fn message(data: &[u8]) -> LiveItem<'_> {
    LiveItem::Message { topic: TOPIC, time_ns: 7, data }
}

/// Returns the messages that wait for a client: those with JSON, and the views.
fn waiting(queues: &mut Queues) -> (Vec<Value>, Vec<Message>) {
    let all = std::iter::from_fn(|| queues.try_next());
    let (texts, views): (Vec<_>, Vec<_>) = all.partition(Message::is_text);
    let json = |message: &Message| serde_json::from_str(message.to_text().expect("it is text"));
    (texts.iter().map(|text| json(text).expect("it is JSON")).collect(), views)
}

fn subscribe(place: &Place, id: u32, channel_id: u32) {
    place.subscribe(&[Subscription { id, channel_id }]);
}

#[test]
fn views_reach_the_clients_with_a_subscription() {
    // Given
    let hub = hub();
    take(&hub, channel_of(TOPIC, b"1"));
    let (one, mut of_one) = hub.connect().expect("there is room");
    let (_other, mut of_other) = hub.connect().expect("there is room");
    let (texts, _) = waiting(&mut of_one);
    assert_eq!((&texts[0]["op"], &texts[1]["channels"][0]["topic"]), (&json!("serverInfo"), &json!(TOPIC)));
    // When
    take(&hub, message(b"early"));
    subscribe(&one, 30, 1);
    take(&hub, message(b"view"));
    // Then
    let (_, views) = waiting(&mut of_one);
    assert_eq!(views, [protocol::message_data(30, 7, b"view")]);
    assert!(waiting(&mut of_other).1.is_empty());
    assert_eq!(hub.counts(), Counts { clients: 2, queued: 1, ..Counts::default() });
    // And: without the subscription nothing comes
    assert_eq!(hub.shared.lock().wanted(), BTreeSet::from([TOPIC.to_owned()]));
    one.unsubscribe(&BTreeSet::from([30]));
    assert!(hub.shared.lock().wanted().is_empty());
    take(&hub, message(b"late"));
    assert!(waiting(&mut of_one).1.is_empty());
}

#[test]
fn slow_client_loses_views_which_are_counted_and_reported() {
    let hub = hub();
    take(&hub, channel_of(TOPIC, b"1"));
    let (place, mut queues) = hub.connect().expect("there is room");
    subscribe(&place, 1, 1);
    for _ in 0..VIEWS_MAX + 3 {
        take(&hub, message(b"view"));
    }
    take(&hub, LiveItem::Missed(2));
    let counts = Counts { clients: 1, queued: VIEWS_MAX as u64, dropped: 3, missed: 2 };
    assert_eq!(hub.counts(), counts);
    hub.shared.lock().report_dropped();
    hub.shared.lock().report_dropped();
    let (texts, views) = waiting(&mut queues);
    assert_eq!(views.len(), VIEWS_MAX);
    let reports: Vec<_> = texts.iter().filter(|text| text["id"] == json!(DROPPED)).collect();
    assert!(
        reports.len() == 1 && reports[0]["message"].as_str().is_some_and(|text| text.starts_with("3 ")),
        "{reports:?}"
    );
    // And: large views are bounded by their bytes
    let large = vec![0; VIEW_BYTES_MAX / 4];
    for _ in 0..5 {
        take(&hub, message(&large));
    }
    assert_eq!(waiting(&mut queues).1.len(), 3);
    assert_eq!(hub.counts().dropped, 5);
    take(&hub, message(b"view"));
    assert_eq!(waiting(&mut queues).1.len(), 1, "a client that reads again has room");
}

#[test]
fn channel_with_another_schema_loses_its_subscriptions() {
    let hub = hub();
    let (place, mut queues) = hub.connect().expect("there is room");
    take(&hub, channel_of(TOPIC, b"1"));
    subscribe(&place, 1, 1);
    take(&hub, channel_of(TOPIC, b"1"));
    take(&hub, channel_of(TOPIC, b"2"));
    let (texts, _) = waiting(&mut queues);
    let ops: Vec<_> = texts.iter().map(|text| text["op"].as_str().unwrap_or_default()).collect();
    assert_eq!(ops, ["serverInfo", "advertise", "unadvertise", "advertise"]);
    assert!(hub.shared.lock().wanted().is_empty());
    subscribe(&place, 2, 2);
    take(&hub, message(b"view"));
    assert_eq!(waiting(&mut queues).1, [protocol::message_data(2, 7, b"view")]);
}

#[test]
fn illegal_subscriptions_are_refused_with_a_reason() {
    let hub = hub();
    take(&hub, channel_of(TOPIC, b"1"));
    let (place, mut queues) = hub.connect().expect("there is room");
    for (id, channel) in [(1, 1), (2, 1), (3, 99)] {
        subscribe(&place, id, channel);
    }
    let (texts, _) = waiting(&mut queues);
    let faults: Vec<_> = texts.iter().filter(|text| text["level"] == json!(2)).collect();
    assert_eq!(faults.len(), 2, "{texts:?}");
    assert_eq!(hub.shared.lock().wanted().len(), 1);
}

#[test]
fn faults_are_shown_once_and_withdrawn() {
    let hub = hub();
    let (_place, mut queues) = hub.connect().expect("there is room");
    for faults in [vec!["a".to_owned()], vec!["a".to_owned()], vec!["b".to_owned()], Vec::new()] {
        hub.shared.lock().set_faults(faults);
    }
    let (texts, _) = waiting(&mut queues);
    let shown: Vec<_> =
        texts[1..].iter().map(|text| text["message"].as_str().unwrap_or("withdrawn")).collect();
    assert_eq!(shown, ["a", "withdrawn", "b", "withdrawn"]);
}

#[test]
fn clients_have_a_bound_and_give_their_places_back() {
    let hub = hub();
    let mut places: Vec<_> = (0..CLIENTS_MAX).map(|_| hub.connect().expect("there is room").0).collect();
    assert!(hub.connect().is_none());
    places.pop();
    assert!(hub.connect().is_some());
}

/// Returns whether the connection of a client is to be closed.
fn is_cut(place: &Place) -> bool {
    let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
    runtime.block_on(async {
        tokio::select! {
            biased;
            () = place.cut.notified() => true,
            () = std::future::ready(()) => false,
        }
    })
}

#[test]
fn client_that_leaves_messages_unread_is_closed() {
    let hub = hub();
    let (place, _queues) = hub.connect().expect("there is room");
    // The first message, which describes the server, waits, too.
    for number in 1..CONTROLS_MAX {
        take(&hub, channel_of(&format!("/{number}"), b""));
    }
    assert!(!is_cut(&place));
    take(&hub, channel_of("/last", b""));
    assert!(is_cut(&place));
    // And: so is one that leaves large ones unread
    let (place, _queues) = hub.connect().expect("there is room");
    let large = "x".repeat(CONTROL_BYTES_MAX / 2);
    place.send(Message::text(large.clone()));
    assert!(!is_cut(&place));
    place.send(Message::text(large));
    assert!(is_cut(&place));
}

#[test]
fn channels_of_a_look_are_announced_together() {
    // Given: more new channels than messages may wait
    let hub = hub();
    let (place, mut queues) = hub.connect().expect("there is room");
    let count = CONTROLS_MAX + 1;
    for number in 0..count {
        hub.shared.lock().take(channel_of(&format!("/{number}"), b""));
    }
    // When
    hub.shared.lock().announce();
    // Then
    assert!(!is_cut(&place));
    let announced = |queues: &mut Queues| {
        let (texts, _) = waiting(queues);
        let ids = texts.iter().flat_map(|text| text["channels"].as_array().into_iter().flatten());
        ids.filter_map(|channel| channel["id"].as_u64()).collect::<Vec<_>>()
    };
    assert_eq!(announced(&mut queues), (1..=count as u64).collect::<Vec<_>>());
    // And: one that is replaced before is not announced
    hub.shared.lock().take(channel_of("/twice", b"1"));
    take(&hub, channel_of("/twice", b"2"));
    assert_eq!(announced(&mut queues), [count as u64 + 2]);
    // And: one that connects in the middle of a look gets each channel once, and so do the others
    hub.shared.lock().take(channel_of("/late", b""));
    let (_other, mut of_other) = hub.connect().expect("there is room");
    hub.shared.lock().announce();
    assert_eq!(announced(&mut queues), [count as u64 + 3]);
    assert_eq!(announced(&mut of_other).len(), count + 2);
}

#[test]
fn errors_of_one_message_are_few_statuses() {
    let hub = hub();
    let (place, mut queues) = hub.connect().expect("there is room");
    let unknown: Vec<_> = (0..1_000).map(|id| Subscription { id, channel_id: id }).collect();
    place.subscribe(&unknown);
    let (texts, _) = waiting(&mut queues);
    assert_eq!(texts.len(), 1 + FAULTS_MAX + 1);
    let last = texts.last().and_then(|text| text["message"].as_str()).expect("it has a text");
    assert!(last.starts_with("984 further"), "{last}");
    assert!(!is_cut(&place));
}

/// A system that hands over one channel, and then a message at each look at which its topic is wanted.
struct Watched(SyncSender<bool>);

struct WatchedLive(SyncSender<bool>);

impl Source for Watched {
    fn snapshot(&self) -> Snapshot {
        NoSystem.snapshot()
    }

    fn parameters(&self) -> Result<Vec<AppParameters>, String> {
        NoSystem.parameters()
    }

    fn set(&self, app: &str, set: &SetParameters) -> Result<ParameterOutcome, String> {
        NoSystem.set(app, set)
    }

    fn stop(&self, act: StopAct) -> Result<StopReport, String> {
        NoSystem.stop(act)
    }

    fn tap(&self) -> Box<dyn Tap> {
        NoSystem.tap()
    }

    fn live(&self) -> Box<dyn Live> {
        Box::new(WatchedLive(self.0.clone()))
    }
}

impl Live for WatchedLive {
    fn poll(&mut self, wanted: &BTreeSet<String>, take: &mut dyn FnMut(LiveItem<'_>)) -> Vec<String> {
        take(channel_of(TOPIC, b"1"));
        if wanted.contains(TOPIC) {
            take(message(b"view"));
        }
        let _ = self.0.try_send(!wanted.is_empty());
        Vec::new()
    }
}

/// Waits for a look at the system that has, or has not, a wanted topic.
fn wait_for(looks: &Taken<bool>, is_wanted: bool) {
    while looks.recv_timeout(WATCHDOG).expect("the thread lives") != is_wanted {}
}

#[test]
fn messages_are_read_only_while_a_client_subscribes() {
    let (look, looks) = sync_channel(1);
    let hub = Hub::start(Arc::new(Watched(look)), "1").expect("a thread");
    let (place, mut queues) = hub.connect().expect("there is room");
    wait_for(&looks, false);
    // The channel of that look may come a moment later.
    let channel = (0..1_000).find_map(|_| {
        let (texts, _) = waiting(&mut queues);
        wait_for(&looks, false);
        texts.iter().find_map(|text| text["channels"][0]["id"].as_u64())
    });
    subscribe(&place, 5, channel.expect("it is announced") as u32);
    wait_for(&looks, true);
    wait_for(&looks, true);
    assert!(waiting(&mut queues).1.contains(&protocol::message_data(5, 7, b"view")));
    place.unsubscribe(&BTreeSet::from([5]));
    wait_for(&looks, false);
    drop(place);
    hub.end();
    // The thread ends, and its reader with it.
    let end = std::iter::repeat_with(|| looks.recv_timeout(WATCHDOG)).find_map(Result::err);
    assert_eq!((end, hub.counts().clients), (Some(RecvTimeoutError::Disconnected), 0));
}
