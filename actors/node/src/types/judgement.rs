//! The verdict on a type that two programs have in different versions. Pure.

use sinew_runtime::wire::MismatchPolicy;
use sinew_schema::{Comparison, Schema, compare};

/// Maximum characters of one difference: names of fields come from another node.
const WORDS_MAX: usize = 256;

/// What happens to messages of a type that differs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Treatment {
    /// They have no difference on the wire, and are delivered.
    Same,
    /// They are delivered: the receiver accepts the additions.
    Accepted,
    /// They are delivered, and the decoder decides: the receiver's policy only warns.
    Warned,
    /// They are refused as `Malformed`.
    Refused,
}

impl Treatment {
    /// Returns the treatment as one word.
    pub(crate) const fn word(self) -> &'static str {
        match self {
            Self::Same => "same",
            Self::Accepted => "accepted",
            Self::Warned => "warned",
            Self::Refused => "refused",
        }
    }
}

/// The treatment of messages of a type, and the reasons.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Judgement {
    pub(crate) treatment: Treatment,
    pub(crate) policy: MismatchPolicy,
    /// The differences in words, each a sentence without its end.
    pub(crate) differences: Vec<String>,
    /// Whether a person should check that both ends mean the same.
    pub(crate) is_doubtful: bool,
}

impl Judgement {
    /// Compares the sender's structure of a type with the receiver's, and applies the receiver's policy.
    pub(crate) fn of(sent: &Schema, handled: &Schema, policy: MismatchPolicy) -> Self {
        let comparison = compare(sent, handled);
        let treatment = match (&comparison, policy) {
            (Comparison::Same, _) => Treatment::Same,
            (Comparison::Addition(_) | Comparison::Conflict(_), MismatchPolicy::Warn) => Treatment::Warned,
            (Comparison::Addition(_), MismatchPolicy::AcceptAdditions) => Treatment::Accepted,
            (Comparison::Addition(_), MismatchPolicy::Refuse)
            | (Comparison::Conflict(_), MismatchPolicy::Refuse | MismatchPolicy::AcceptAdditions) => {
                Treatment::Refused
            }
        };
        let words = comparison.differences().iter().map(ToString::to_string);
        let differences = words.map(|words| words.chars().take(WORDS_MAX).collect()).collect();
        let is_doubtful = comparison.differences().iter().any(|one| one.is_doubtful);
        Self { treatment, policy, differences, is_doubtful }
    }
}

/// Returns the line of the log about messages of a type that differs: their treatment, the reason, the remedy.
/// Both ends are named with their nodes.
pub(super) fn sentence(
    (source, target): (&str, &str),
    type_name: &str,
    judgement: &Judgement,
    seen: u64,
) -> String {
    let Judgement { treatment, policy, differences, is_doubtful } = judgement;
    let differences = differences.join("; ");
    let (done, remedy) = match treatment {
        Treatment::Refused => (
            "refuses",
            "build both programs with one version of the type; a type with `MISMATCH: MismatchPolicy::Warn` at the \
             receiver would leave the decision to the decoder",
        ),
        Treatment::Warned => ("decodes", "build both programs with one version of the type"),
        Treatment::Accepted if *is_doubtful => {
            ("accepts", "check that both programs mean the same, or build both with one version of the type")
        }
        Treatment::Accepted | Treatment::Same => ("accepts", "both programs can stay as they are"),
    };
    let policy = policy.word();
    format!(
        "{target} {done} messages of {type_name} from {source}, {seen} so far: {differences} (policy of the receiver: \
         {policy}); {remedy}"
    )
}

#[cfg(test)]
mod tests {
    use serde::{Deserialize, Serialize};

    use super::*;

    #[derive(Serialize, Deserialize)]
    struct Gains {
        kp: f32,
    }

    #[derive(Serialize, Deserialize)]
    struct WithDamping {
        kp: f32,
        kd: f32,
    }

    #[derive(Serialize, Deserialize)]
    struct Renamed {
        gain: f32,
    }

    #[derive(Serialize, Deserialize)]
    struct AsText {
        kp: String,
    }

    fn judged<S: Serialize + serde::de::DeserializeOwned, H: Serialize + serde::de::DeserializeOwned>(
        policy: MismatchPolicy,
    ) -> Judgement {
        Judgement::of(&Schema::of::<S>().unwrap(), &Schema::of::<H>().unwrap(), policy)
    }

    #[test]
    fn additions_pass_and_all_else_is_refused_by_default() {
        let default = MismatchPolicy::default();
        assert_eq!(judged::<Gains, Gains>(default).treatment, Treatment::Same);
        let more = judged::<WithDamping, Gains>(default);
        assert_eq!(more.treatment, Treatment::Accepted);
        assert_eq!(more.differences, ["field `kd` is missing at the receiver"]);
        let less = judged::<Gains, WithDamping>(default);
        assert_eq!(less.treatment, Treatment::Refused);
        assert_eq!(less.differences, ["field `kd` is missing at the sender"]);
        let renamed = judged::<Renamed, Gains>(default);
        assert_eq!(renamed.treatment, Treatment::Refused);
        assert_eq!(
            renamed.differences,
            ["field `gain` (f32) at the sender seems to be `kp` (f32) at the receiver"]
        );
        let as_text = judged::<Gains, AsText>(default);
        assert_eq!(as_text.treatment, Treatment::Refused);
        assert_eq!(as_text.differences, ["`kp` is f32 at the sender and text at the receiver"]);
    }

    #[test]
    fn doubtful_addition_is_accepted_with_a_warning() {
        #[derive(Serialize, Deserialize)]
        struct Newtons(f32);
        #[derive(Serialize, Deserialize)]
        struct InNewtons {
            kp: Newtons,
        }
        let judgement = judged::<Gains, InNewtons>(MismatchPolicy::default());
        assert_eq!((judgement.treatment, judgement.is_doubtful), (Treatment::Accepted, true));
        let words = sentence(("gait", "knee"), "demo.gains", &judgement, 1);
        assert!(words.contains("check that both programs mean the same"), "{words}");
        assert!(!judged::<WithDamping, Gains>(MismatchPolicy::default()).is_doubtful);
    }

    #[test]
    fn each_policy_treats_differences_in_its_way() {
        let of = |policy| (judged::<WithDamping, Gains>(policy), judged::<Renamed, Gains>(policy));
        let treatments = |policy| {
            let (addition, conflict) = of(policy);
            (addition.treatment, conflict.treatment)
        };
        assert_eq!(treatments(MismatchPolicy::Refuse), (Treatment::Refused, Treatment::Refused));
        assert_eq!(treatments(MismatchPolicy::Warn), (Treatment::Warned, Treatment::Warned));
        assert_eq!(judged::<Gains, Gains>(MismatchPolicy::Refuse).treatment, Treatment::Same);
    }

    #[test]
    fn sentence_names_ends_reason_policy_and_remedy() {
        let judgement = judged::<Gains, AsText>(MismatchPolicy::default());
        let words = sentence(("gait at hip", "knee.drive at knee"), "demo.gains", &judgement, 3);
        assert_eq!(
            words,
            "knee.drive at knee refuses messages of demo.gains from gait at hip, 3 so far: `kp` is f32 at the sender and \
             text at the receiver (policy of the receiver: accept-additions); build both programs with one version of \
             the type; a type with `MISMATCH: MismatchPolicy::Warn` at the receiver would leave the decision to the \
             decoder"
        );
    }
}
