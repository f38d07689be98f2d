//! The answers to requests: metrics, files of the page, its stream, and its writes.

use std::{
    net::IpAddr,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use http_body_util::{BodyExt as _, Limited};
use hyper::{
    Request, Response, StatusCode,
    body::{Body as _, Bytes, Incoming},
    header::{
        ALLOW, CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HeaderValue, REFERRER_POLICY,
        SET_COOKIE, X_CONTENT_TYPE_OPTIONS,
    },
};
use serde::Deserialize;
use serde_json::json;
use sinew::{
    Time,
    parameters::{NamedValue, ParameterOutcome, SetParameters, Value},
};
use tokio::{sync::Semaphore, task::spawn_blocking, time::timeout};

use crate::{
    assets::{self, Asset},
    auth::{self, Token},
    body::Content,
    cache::{Cache, FRESH, PAGE_FRESH},
    events::EventLog,
    foxglove::Hub,
    listed::Listed,
    metrics::{self, Format},
    model,
    pages::{Pages, wall_s},
    request::{self, Access, Document, Head, RequestError},
    source::Source,
    stop::{self, StopAct},
    stream::{self, Line, States},
};

/// Time limit from the request to the begin of the answer, except for questions to applications.
const ANSWER_WITHIN: Duration = Duration::from_secs(5);
/// Time limit for questions to applications.
const ASKED_WITHIN: Duration = Duration::from_secs(12);
/// Bytes of the body of a request.
const BODY_BYTES_MAX: usize = 16 * 1_024;
/// Parameters of one set of an application.
pub(crate) const VALUES_MAX: usize = 64;
/// Questions to applications at a time. Further ones wait.
const QUESTIONS_MAX: usize = 2;
/// Presses and releases of the stop at a time. They wait for no question.
const STOP_ACTS_MAX: usize = 8;

/// The parts that all connections share.
pub(crate) struct Shared {
    pub(crate) source: Arc<dyn Source>,
    pub(crate) cache: Cache,
    pub(crate) pages: Pages,
    pub(crate) states: States,
    /// The clients of Foxglove's protocol, if there is a server for them.
    foxglove: Option<Hub>,
    listed: Listed,
    log: Mutex<EventLog>,
    questions: Arc<Semaphore>,
    /// The state of the stop.
    stop: Listed,
    /// One question for that state at a time.
    stop_questions: Arc<Semaphore>,
    stop_acts: Arc<Semaphore>,
}

impl Shared {
    pub(crate) fn new(source: Arc<dyn Source>, cache: Cache, pages: Pages, foxglove: Option<Hub>) -> Self {
        let slots = |count| Arc::new(Semaphore::new(count));
        Self {
            source,
            cache,
            pages,
            states: States::default(),
            foxglove,
            listed: Listed::default(),
            log: Mutex::default(),
            questions: slots(QUESTIONS_MAX),
            stop: Listed::default(),
            stop_questions: slots(1),
            stop_acts: slots(STOP_ACTS_MAX),
        }
    }

    pub(crate) fn log(&self) -> MutexGuard<'_, EventLog> {
        self.log.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns those of a server without a system.
    #[cfg(test)]
    pub(crate) fn without_system() -> Arc<Self> {
        let source: Arc<dyn Source> = Arc::new(crate::source::NoSystem);
        let cache = Cache::start(Arc::clone(&source), Duration::ZERO).expect("a thread");
        let pages = Pages::start(Arc::clone(&source)).expect("a thread");
        Arc::new(Self::new(source, cache, pages, None))
    }

    /// Adds a set with its outcome to the log of events.
    fn record(&self, app: &str, order: &SetParameters, outcome: &Result<ParameterOutcome, String>) {
        let is_applied = matches!(outcome, Ok(ParameterOutcome::Applied { .. }));
        self.log().write((wall_s() * 1e3) as u64, app, sentence(order, outcome), is_applied);
    }
}

/// The server's own address and token.
#[derive(Debug)]
pub(crate) struct Identity {
    pub(crate) listens: IpAddr,
    pub(crate) token: Token,
    pub(crate) cookie: String,
}

/// A set of parameters, as the page sends it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Order {
    app: String,
    /// The new values, each as a text; without any, the last set is undone.
    #[serde(default)]
    values: Vec<OrderedValue>,
    #[serde(default)]
    undo: bool,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct OrderedValue {
    name: String,
    value: String,
}

impl Order {
    /// Reads a body.
    fn read(body: &[u8]) -> Result<(String, SetParameters), String> {
        let order: Self = serde_json::from_slice(body).map_err(|why| format!("this is no set: {why}"))?;
        if order.undo && order.values.is_empty() {
            return Ok((order.app, SetParameters::Undo));
        }
        if order.undo || order.values.is_empty() || order.values.len() > VALUES_MAX {
            return Err(format!("a set has 1 to {VALUES_MAX} values, or undoes the last one"));
        }
        let value = |one: OrderedValue| match one.value.trim().parse::<Value>() {
            Ok(value) => Ok(NamedValue { name: one.name, value }),
            Err(why) => Err(format!("{}: {why}", one.name)),
        };
        let values: Result<Vec<_>, _> = order.values.into_iter().map(value).collect();
        Ok((order.app, SetParameters::Values(values?)))
    }
}

/// Answers a request.
pub(crate) async fn answer(
    request: Request<Incoming>,
    shared: &Arc<Shared>,
    (own, line): (&Identity, &Arc<Line>),
) -> Response<Content> {
    let (head, body) = request.into_parts();
    let has_body = !body.is_end_stream();
    let of = Head { method: &head.method, uri: &head.uri, headers: &head.headers, has_body };
    let access = Access { listens: own.listens, token: &own.token, cookie: &own.cookie };
    match request::document(of, access) {
        Err(error) => refused(error),
        Ok(Document::Metrics(format)) => metrics(shared, format).await,
        Ok(Document::File(asset)) => file(asset),
        Ok(Document::Login) => {
            let mut response = file(assets::find("/").expect("the page is part of the program"));
            if let Ok(cookie) = HeaderValue::from_str(&auth::set_cookie(&own.cookie, &own.token)) {
                response.headers_mut().insert(SET_COOKIE, cookie);
            }
            response
        }
        Ok(Document::Stream(look)) => match stream::open(shared, line, look) {
            Some(events) => response(StatusCode::OK, "text/event-stream", Content::Events(events)),
            None => plain(StatusCode::SERVICE_UNAVAILABLE, "too many pages are open; close one".to_owned()),
        },
        Ok(Document::Parameters) => parameters(shared).await,
        Ok(Document::Set) => set(shared, body).await,
        Ok(Document::Stop) => act_on_stop(shared, body).await,
    }
}

async fn metrics(shared: &Shared, format: Format) -> Response<Content> {
    let Ok(Some(snapshot)) = timeout(ANSWER_WITHIN, shared.cache.snapshot(FRESH)).await else {
        let why = format!("the nodes gave no answer within {ANSWER_WITHIN:?}; try again");
        return plain(StatusCode::SERVICE_UNAVAILABLE, why);
    };
    let foxglove = shared.foxglove.as_ref().map(Hub::counts);
    match metrics::encode(&snapshot, foxglove, Time::now(), format) {
        Ok(text) => response(StatusCode::OK, format.content_type(), Content::whole(text.into())),
        Err(_) => {
            plain(StatusCode::INTERNAL_SERVER_ERROR, "the metrics cannot be written as text".to_owned())
        }
    }
}

async fn parameters(shared: &Arc<Shared>) -> Response<Content> {
    match listed(shared).await {
        Ok(list) => json(StatusCode::OK, &list),
        Err(why) => json(StatusCode::SERVICE_UNAVAILABLE, &json!({ "fault": why })),
    }
}

/// Returns the parameters of all applications, as JSON: the latest list, or a new one.
pub(crate) async fn listed(shared: &Arc<Shared>) -> Result<serde_json::Value, String> {
    let ask = || async {
        let apps = asked(shared, &shared.questions, |source| source.parameters()).await.flatten()?;
        Ok::<_, String>(model::parameters(&apps))
    };
    let late = || Err(format!("the nodes gave no answer within {ASKED_WITHIN:?}; try again"));
    timeout(ASKED_WITHIN, shared.listed.get(PAGE_FRESH, ask)).await.unwrap_or_else(|_| late())
}

/// Presses or releases the stop. The act is recorded in the log of events and on the terminal.
async fn act_on_stop(shared: &Arc<Shared>, body: Incoming) -> Response<Content> {
    let body = match whole(body).await {
        Ok(body) => body,
        Err(why) => return json(StatusCode::PAYLOAD_TOO_LARGE, &json!({ "fault": why })),
    };
    let act = match StopAct::read(&body) {
        Ok(act) => act,
        Err(why) => return json(StatusCode::BAD_REQUEST, &json!({ "fault": why })),
    };
    let of = Arc::clone(shared);
    let acted = asked(shared, &shared.stop_acts, move |source| {
        let report = source.stop(act);
        of.stop.forget();
        let (text, is_fine) = act.sentence(&report);
        of.log().write((wall_s() * 1e3) as u64, "stop", text, is_fine);
        report
    });
    match acted.await.flatten() {
        Ok(report) => json(StatusCode::OK, &json!({ "report": stop::json(&report) })),
        Err(why) => json(StatusCode::CONFLICT, &json!({ "fault": why })),
    }
}

/// Returns the state of the stop, or why it is not known, as JSON.
pub(crate) async fn stop_state(shared: &Arc<Shared>) -> serde_json::Value {
    let ask = || async {
        let asked = asked(shared, &shared.stop_questions, |source| source.stop(StopAct::Ask));
        Ok::<_, String>(stop::json(&asked.await.flatten()?))
    };
    shared.stop.get(PAGE_FRESH, ask).await.unwrap_or_else(|why| json!({ "fault": why }))
}

/// Reads a body to its end.
async fn whole(body: Incoming) -> Result<Bytes, String> {
    match timeout(ANSWER_WITHIN, Limited::new(body, BODY_BYTES_MAX).collect()).await {
        Ok(Ok(body)) => Ok(body.to_bytes()),
        Ok(Err(_)) | Err(_) => {
            Err(format!("the body has to arrive whole, with at most {BODY_BYTES_MAX} bytes"))
        }
    }
}

/// Sets parameters. The set is recorded in the log of events and on the terminal.
async fn set(shared: &Arc<Shared>, body: Incoming) -> Response<Content> {
    let body = match whole(body).await {
        Ok(body) => body,
        Err(why) => return json(StatusCode::PAYLOAD_TOO_LARGE, &json!({ "fault": why })),
    };
    let (app, order) = match Order::read(&body) {
        Ok(order) => order,
        Err(why) => return json(StatusCode::BAD_REQUEST, &json!({ "fault": why })),
    };
    match apply(shared, app, order).await {
        Ok(outcome) => json(StatusCode::OK, &json!({ "outcome": outcome })),
        Err(why) => json(StatusCode::CONFLICT, &json!({ "fault": why })),
    }
}

/// Sets parameters. Its outcome is logged where it is known: the page may have closed its connection meanwhile.
pub(crate) async fn apply(
    shared: &Arc<Shared>,
    app: String,
    order: SetParameters,
) -> Result<ParameterOutcome, String> {
    let of = Arc::clone(shared);
    let outcome = asked(shared, &shared.questions, move |source| {
        let outcome = source.set(&app, &order);
        of.listed.forget();
        of.record(&app, &order, &outcome);
        outcome
    });
    outcome.await.flatten()
}

/// Returns the sentence of the log.
fn sentence(order: &SetParameters, outcome: &Result<ParameterOutcome, String>) -> String {
    let list = |values: &[NamedValue]| {
        let each: Vec<_> = values.iter().map(|one| format!("{} = {}", one.name, one.value)).collect();
        each.join(", ")
    };
    let order = match order {
        SetParameters::Undo => "undo of the last set".to_owned(),
        SetParameters::Values(values) => list(values),
        // The page sends neither.
        SetParameters::Prepare(_) | SetParameters::Conclude(_) => "transaction".to_owned(),
    };
    match outcome {
        Ok(ParameterOutcome::Applied { tick, values, .. }) => {
            let place =
                if *tick == 0 { "between two messages".to_owned() } else { format!("at tick {tick}") };
            format!("{order}: applied {place}: {}", list(values))
        }
        Ok(ParameterOutcome::Held { .. }) => format!("{order}: held"),
        Ok(ParameterOutcome::Refused { why }) => format!("{order}: refused: {why}"),
        Err(why) => format!("{order}: {why}"),
    }
}

/// Asks the system on a thread of its own: as many at a time as there are slots.
async fn asked<R: Send + 'static>(
    shared: &Arc<Shared>,
    slots: &Arc<Semaphore>,
    ask: impl FnOnce(&dyn Source) -> R + Send + 'static,
) -> Result<R, String> {
    let work = async {
        let slot = Arc::clone(slots).acquire_owned().await.map_err(|_| "it ends".to_owned())?;
        let source = Arc::clone(&shared.source);
        let asked = spawn_blocking(move || {
            let _slot = slot;
            ask(&*source)
        });
        asked.await.map_err(|why| format!("sinew view failed while it asked: {why}; report this"))
    };
    let late = format!("no answer within {ASKED_WITHIN:?}; it may be done: look at the present state");
    timeout(ASKED_WITHIN, work).await.map_err(|_| late)?
}

fn file(asset: &'static Asset) -> Response<Content> {
    response(StatusCode::OK, asset.content_type, Content::whole(Bytes::from_static(asset.bytes)))
}

fn json(status: StatusCode, value: &serde_json::Value) -> Response<Content> {
    response(status, "application/json", Content::whole(value.to_string().into()))
}

pub(crate) fn refused(error: RequestError) -> Response<Content> {
    let mut response = plain(error.status(), error.to_string());
    if let RequestError::Method(allowed) = error {
        response.headers_mut().insert(ALLOW, HeaderValue::from_static(allowed));
    }
    response
}

fn plain(status: StatusCode, text: String) -> Response<Content> {
    response(status, "text/plain; charset=utf-8", Content::whole((text + "\n").into()))
}

fn response(status: StatusCode, content_type: &'static str, content: Content) -> Response<Content> {
    let mut response = Response::new(content);
    *response.status_mut() = status;
    let headers = response.headers_mut();
    let fixed = [
        (CONTENT_TYPE, content_type),
        (CACHE_CONTROL, "no-store"),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (REFERRER_POLICY, "no-referrer"),
        (
            CONTENT_SECURITY_POLICY,
            "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self'; \
             base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        ),
    ];
    for (name, value) in fixed {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

#[cfg(test)]
mod tests {
    use super::*;

    fn named(name: &str, value: Value) -> NamedValue {
        NamedValue { name: name.to_owned(), value }
    }

    #[test]
    fn body_is_a_set_or_an_undo() {
        let read = |text: &str| Order::read(text.as_bytes());
        let set =
            read(r#"{"app":"knee","values":[{"name":"gain","value":"0.5"},{"name":"on","value":"true"}]}"#);
        let values = vec![named("gain", Value::Number(0.5)), named("on", Value::Flag(true))];
        assert_eq!(set, Ok(("knee".to_owned(), SetParameters::Values(values))));
        assert_eq!(read(r#"{"app":"knee","undo":true}"#), Ok(("knee".to_owned(), SetParameters::Undo)));
    }

    #[test]
    fn other_bodies_are_refused_with_a_reason() {
        let many = [r#"{"name":"gain","value":"1"}"#; VALUES_MAX + 1].join(",");
        for body in [
            String::new(),
            "[]".to_owned(),
            r#"{"app":"knee"}"#.to_owned(),
            r#"{"app":"knee","undo":true,"values":[{"name":"gain","value":"1"}]}"#.to_owned(),
            r#"{"app":"knee","values":[{"name":"gain","value":"fast"}]}"#.to_owned(),
            r#"{"app":"knee","undo":true,"role":"operator"}"#.to_owned(),
            format!(r#"{{"app":"knee","values":[{many}]}}"#),
        ] {
            assert!(Order::read(body.as_bytes()).is_err(), "{body}");
        }
    }

    #[test]
    fn set_is_logged_also_after_its_page_has_gone() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
        runtime.expect("a runtime").block_on(async {
            let shared = Shared::without_system();
            tokio::select! {
                biased;
                _ = apply(&shared, "knee".to_owned(), SetParameters::Undo) => {}
                () = std::future::ready(()) => {}
            }
            // The question has ended when its place is free again.
            let all = u32::try_from(QUESTIONS_MAX).expect("it is small");
            let _all = shared.questions.acquire_many(all).await.expect("nothing closes it");
            let events = shared.log().after(0);
            assert_eq!(events.len(), 1);
            assert_eq!((events[0].topic, events[0].subject.as_str()), ("write", "knee"));
        });
    }

    #[test]
    fn write_is_logged_with_its_outcome() {
        let order = SetParameters::Values(vec![named("gain", Value::Number(0.5))]);
        let refused = Ok(ParameterOutcome::Refused { why: "outside 0 to 1".to_owned() });
        assert_eq!(sentence(&order, &refused), "gain = 0.5: refused: outside 0 to 1");
        let applied = Ok(ParameterOutcome::Applied { tick: 0, at_ns: 1, values: Vec::new() });
        assert_eq!(
            sentence(&SetParameters::Undo, &applied),
            "undo of the last set: applied between two messages: "
        );
        let fault = Err("no right".to_owned());
        assert_eq!(sentence(&SetParameters::Undo, &fault), "undo of the last set: no right");
    }

    #[test]
    fn answers_forbid_foreign_and_inline_scripts() {
        let response = plain(StatusCode::OK, String::new());
        let policy = response.headers()[CONTENT_SECURITY_POLICY].to_str().expect("it is text");
        assert!(policy.starts_with("default-src 'none'") && !policy.contains("unsafe"), "{policy}");
    }
}
