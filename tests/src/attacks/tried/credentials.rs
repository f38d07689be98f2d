//! Who shows what is not his, or nothing.

use std::{
    io,
    sync::Arc,
    time::{Duration, Instant},
};

use sinew::security::rustls::{AlertDescription, Error};

use super::{
    super::{
        keys::{self, Who},
        robot::Is,
        stranger::{Answer, Client, Stranger, client},
    },
    Happened, Scene, done,
};

/// Time between two handshakes.
const PACE: Duration = Duration::from_millis(20);

/// The node's words for who has not proven who he is, and for who has proven to be another one.
pub(super) const NOT_PROVEN: &str = "peer not proven";
pub(super) const SECURITY: &str = "security";

/// What a node says of every certificate that it reads and does not take: why is for its own log.
const NOT_TAKEN: AlertDescription = AlertDescription::CertificateUnknown;

/// How an attempt is to end.
#[derive(Clone, Copy)]
enum Expected {
    /// By an alert of TLS. Where the node has closed before this end has read it, the system says that the connection was cut.
    Alert(AlertDescription),
    /// By a REFUSAL whose sentence has these words.
    Refusal(&'static str),
}

impl Expected {
    /// The cause under which the node counts such an end.
    const fn cause(self) -> &'static str {
        match self {
            Self::Alert(_) => NOT_PROVEN,
            Self::Refusal(_) => SECURITY,
        }
    }
}

/// What became of handshakes.
#[derive(Default)]
struct Tally {
    tried: u64,
    came_in: u64,
    /// Ended as they are to.
    as_expected: u64,
    /// Ended without a word that this end could read.
    cut: u64,
    /// Of one that ended as it is to.
    words: Option<String>,
    /// Of one that ended otherwise.
    otherwise: Option<String>,
}

impl Tally {
    fn note(&mut self, answer: io::Result<Answer>, expected: Expected) {
        self.tried += 1;
        let words = match (answer, expected) {
            (Ok(Answer::Welcome), _) => {
                self.came_in += 1;
                return;
            }
            (Ok(Answer::Refused(words)), Expected::Refusal(part)) if words.contains(part) => words,
            (Ok(Answer::Refused(words)), _) => return self.otherwise = Some(words),
            (Err(error), Expected::Alert(alert)) if alert_of(&error) == Some(alert) => error.to_string(),
            (Err(error), Expected::Alert(_)) if is_cut(&error) => return self.cut += 1,
            (Err(error), _) => return self.otherwise = Some(error.to_string()),
        };
        self.as_expected += 1;
        self.words = Some(words);
    }

    fn happened(self, who: &str, expected: Expected) -> Happened {
        let Self { tried, came_in, as_expected, cut, words, otherwise } = self;
        let (mut broken, mut let_in) = (Vec::new(), Vec::new());
        if came_in > 0 {
            let_in.push(format!("{who}: {came_in} of {tried} came in"));
        }
        if as_expected == 0 {
            broken.push(format!("{who}: none of {tried} was refused as it is to be, {cut} were cut"));
        }
        broken.extend(otherwise.map(|words| format!("{who}: one ended otherwise: {words}")));
        let words = words.unwrap_or_else(|| "nothing".to_owned());
        let what = format!("{who}: {tried} tried, {came_in} came in, {cut} cut; told: {words}");
        Happened {
            let_in,
            refused: vec![(expected.cause(), tried)],
            done: done("handshakes", tried),
            ..Happened::new(what, broken)
        }
    }
}

fn alert_of(error: &io::Error) -> Option<AlertDescription> {
    let Error::AlertReceived(alert) = error.get_ref()?.downcast_ref::<Error>()? else { return None };
    Some(*alert)
}

fn is_cut(error: &io::Error) -> bool {
    use io::ErrorKind::{BrokenPipe, ConnectionAborted, ConnectionReset, UnexpectedEof};
    matches!(error.kind(), BrokenPipe | ConnectionAborted | ConnectionReset | UnexpectedEof)
}

/// Who tries, what he shows, and how that is to end.
struct Attempt<'a> {
    who: &'static str,
    shows: Option<&'a Arc<Client>>,
    says: Who,
    expected: Expected,
}

/// Tries it again and again for so long.
fn shake(scene: &Scene<'_>, lasts: Duration, attempt: &Attempt<'_>) -> Happened {
    let &Attempt { who, shows, says, expected } = attempt;
    let until = Instant::now() + lasts;
    let mut tallies = scene.on_threads(1, |_| {
        let mut tally = Tally::default();
        while !scene.is_over() && Instant::now() < until {
            let dialled = Stranger::dial(scene.target.connections, shows);
            match scene.target.is {
                Is::Node => {
                    let peer = scene.robot.knee_address();
                    let answer = dialled.and_then(|mut stranger| stranger.hello(says, peer));
                    tally.note(answer, expected);
                }
                Is::Decoy => {
                    // Where nobody listens nothing was tried. Nothing is said in return, and whether what is said there still arrives is all the same.
                    tally.tried += u64::from(dialled.is_ok());
                    let _ = dialled.and_then(|mut it| it.say_hello(says, scene.robot.knee_address()));
                }
            }
            scene.rest(PACE);
        }
        tally
    });
    tallies.pop().unwrap_or_default().happened(who, expected)
}

/// Tries one after the other, each for as long.
fn shake_in_turn(scene: &Scene<'_>, attempts: &[Attempt<'_>]) -> Happened {
    let lasts = scene.lasts / attempts.len().max(1) as u32;
    attempts.iter().map(|attempt| shake(scene, lasts, attempt)).reduce(Happened::and).unwrap_or_default()
}

pub(super) fn wrong_authority(scene: &Scene<'_>) -> Happened {
    let [own, hip] = [keys::MALLORY, keys::HIP].map(|who| scene.keys.tls_of_others(who));
    let expected = Expected::Alert(NOT_TAKEN);
    let attempts = [
        Attempt { who: "as itself", shows: Some(&own), says: keys::MALLORY, expected },
        Attempt {
            who: "as hip, with a certificate that says so",
            shows: Some(&hip),
            says: keys::HIP,
            expected,
        },
    ];
    shake_in_turn(scene, &attempts)
}

pub(super) fn none(scene: &Scene<'_>) -> Happened {
    let nothing = client(None);
    let attempts = [
        Attempt {
            who: "TLS",
            shows: Some(&nothing),
            says: keys::MALLORY,
            expected: Expected::Alert(AlertDescription::CertificateRequired),
        },
        Attempt {
            who: "without TLS",
            shows: None,
            says: keys::MALLORY,
            expected: Expected::Refusal("you do not speak TLS"),
        },
    ];
    shake_in_turn(scene, &attempts)
}

pub(super) fn stolen(scene: &Scene<'_>) -> Happened {
    let (spare, revoked) = (scene.keys.tls(keys::SPARE), scene.keys.tls(keys::REVOKED));
    let another = Expected::Refusal("your certificate is of node");
    let attempts = [
        Attempt { who: "as hip", shows: Some(&spare), says: keys::HIP, expected: another },
        Attempt { who: "as knee itself", shows: Some(&spare), says: keys::KNEE, expected: another },
        Attempt {
            who: "revoked",
            shows: Some(&revoked),
            says: keys::REVOKED,
            expected: Expected::Alert(NOT_TAKEN),
        },
    ];
    shake_in_turn(scene, &attempts)
}
