//! Attackers with foreign credentials or none.

use std::{
    io,
    sync::Arc,
    time::{Duration, Instant},
};

use sinew::security::rustls::{AlertDescription, Error};

use super::{
    super::{
        keys::{self, TestNode},
        raw_peer::{Answer, Client, RawPeer, client},
        robot::Is,
    },
    Happened, Scene, done,
};

/// Time between two handshakes.
const PACE: Duration = Duration::from_millis(20);

/// The node's causes for a peer without a proven identity, and for a peer with a proven but different
/// identity.
pub(super) const NOT_PROVEN: &str = "peer not proven";
pub(super) const SECURITY: &str = "security";

/// A node's alert for every certificate that it can parse but rejects. The reason is only in its own log.
const NOT_TAKEN: AlertDescription = AlertDescription::CertificateUnknown;

/// The expected end of an attempt.
#[derive(Clone, Copy)]
enum Expected {
    /// A TLS alert. If the node closes before this end has read the alert, the system reports a connection
    /// reset.
    Alert(AlertDescription),
    /// A REFUSAL with a reason that contains these words.
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

/// The results of the handshakes.
#[derive(Default)]
struct Tally {
    tried: u64,
    came_in: u64,
    /// Ended as expected.
    as_expected: u64,
    /// Ended without a readable message.
    cut: u64,
    /// Message of an attempt that ended as expected.
    words: Option<String>,
    /// Message of an attempt that ended otherwise.
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

    fn happened(self, label: &str, expected: Expected) -> Happened {
        let Self { tried, came_in, as_expected, cut, words, otherwise } = self;
        let (mut broken, mut let_in) = (Vec::new(), Vec::new());
        if came_in > 0 {
            let_in.push(format!("{label}: {came_in} of {tried} came in"));
        }
        if as_expected == 0 {
            broken.push(format!("{label}: none of {tried} was refused as it is to be, {cut} were cut"));
        }
        broken.extend(otherwise.map(|words| format!("{label}: one ended otherwise: {words}")));
        let words = words.unwrap_or_else(|| "nothing".to_owned());
        let what = format!("{label}: {tried} tried, {came_in} came in, {cut} cut; reported: {words}");
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

/// An attempt: its client, its credentials, and the expected end.
struct Attempt<'a> {
    label: &'static str,
    shows: Option<&'a Arc<Client>>,
    claimed: TestNode,
    expected: Expected,
}

/// Repeats the attempt for this duration.
fn shake(scene: &Scene<'_>, lasts: Duration, attempt: &Attempt<'_>) -> Happened {
    let &Attempt { label, shows, claimed, expected } = attempt;
    let until = Instant::now() + lasts;
    let mut tallies = scene.on_threads(1, |_| {
        let mut tally = Tally::default();
        while !scene.is_over() && Instant::now() < until {
            let dialled = RawPeer::dial(scene.target.connections, shows);
            match scene.target.is {
                Is::Node => {
                    let peer = scene.robot.knee_address();
                    let answer = dialled.and_then(|mut raw_peer| raw_peer.hello(claimed, peer));
                    tally.note(answer, expected);
                }
                Is::Decoy => {
                    // Without a listener nothing was tried. The decoy sends no reply, and it does not matter
                    // whether the HELLO arrives.
                    tally.tried += u64::from(dialled.is_ok());
                    let _ = dialled.and_then(|mut it| it.send_hello(claimed, scene.robot.knee_address()));
                }
            }
            scene.rest(PACE);
        }
        tally
    });
    tallies.pop().unwrap_or_default().happened(label, expected)
}

/// Runs the attempts one after the other, each for the same duration.
fn shake_in_turn(scene: &Scene<'_>, attempts: &[Attempt<'_>]) -> Happened {
    let lasts = scene.lasts / attempts.len().max(1) as u32;
    attempts.iter().map(|attempt| shake(scene, lasts, attempt)).reduce(Happened::and).unwrap_or_default()
}

pub(super) fn wrong_authority(scene: &Scene<'_>) -> Happened {
    let [own, hip] = [keys::MALLORY, keys::HIP].map(|node| scene.keys.tls_of_others(node));
    let expected = Expected::Alert(NOT_TAKEN);
    let attempts = [
        Attempt { label: "as itself", shows: Some(&own), claimed: keys::MALLORY, expected },
        Attempt {
            label: "as hip, with a certificate that says so",
            shows: Some(&hip),
            claimed: keys::HIP,
            expected,
        },
    ];
    shake_in_turn(scene, &attempts)
}

pub(super) fn none(scene: &Scene<'_>) -> Happened {
    let nothing = client(None);
    let attempts = [
        Attempt {
            label: "TLS",
            shows: Some(&nothing),
            claimed: keys::MALLORY,
            expected: Expected::Alert(AlertDescription::CertificateRequired),
        },
        Attempt {
            label: "without TLS",
            shows: None,
            claimed: keys::MALLORY,
            expected: Expected::Refusal("you do not speak TLS"),
        },
    ];
    shake_in_turn(scene, &attempts)
}

pub(super) fn stolen(scene: &Scene<'_>) -> Happened {
    let (spare, revoked) = (scene.keys.tls(keys::SPARE), scene.keys.tls(keys::REVOKED));
    let another = Expected::Refusal("your certificate is of node");
    let attempts = [
        Attempt { label: "as hip", shows: Some(&spare), claimed: keys::HIP, expected: another },
        Attempt { label: "as knee itself", shows: Some(&spare), claimed: keys::KNEE, expected: another },
        Attempt {
            label: "revoked",
            shows: Some(&revoked),
            claimed: keys::REVOKED,
            expected: Expected::Alert(NOT_TAKEN),
        },
    ];
    shake_in_turn(scene, &attempts)
}
