//! The treatment of messages of a type that their sender was built with in another version.

/// What a node does with messages of a type that the sender's program and the receiver's declare differently.
///
/// The receiver's type decides: [`Payload::MISMATCH`](super::Payload::MISMATCH). A type with an unknown structure, of
/// either end, is not compared: then the decoder decides.
///
/// # Examples
///
/// ```
/// use sinew::{MismatchPolicy, Payload, serde::{Deserialize, Serialize}};
///
/// /// A limit of force. A message of another declared version of it is refused.
/// #[derive(Serialize, Deserialize)]
/// #[serde(crate = "sinew::serde")]
/// struct ForceLimit { newtons: f32 }
///
/// impl Payload for ForceLimit {
///     const NAME: &'static str = "demo.force_limit";
///     const MISMATCH: MismatchPolicy = MismatchPolicy::Refuse;
/// }
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MismatchPolicy {
    /// Any difference is refused, also before the node has the sender's structure. A message that comes before the
    /// sender's node has declared its type is decoded as usual.
    Refuse,
    /// Each difference is logged, and the decoder decides on each message.
    Warn,
    /// Additions that the receiver's decoder accepts pass, and are logged once. Any other difference is refused.
    #[default]
    AcceptAdditions,
}

impl MismatchPolicy {
    /// Returns the policy as one word: `refuse`, `warn` or `accept-additions`.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Refuse => "refuse",
            Self::Warn => "warn",
            Self::AcceptAdditions => "accept-additions",
        }
    }

    /// Returns the policy of a [`word`](Self::word).
    #[must_use]
    pub fn of_word(word: &str) -> Option<Self> {
        [Self::Refuse, Self::Warn, Self::AcceptAdditions].into_iter().find(|policy| policy.word() == word)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_policy_has_a_word_of_its_own() {
        for policy in [MismatchPolicy::Refuse, MismatchPolicy::Warn, MismatchPolicy::AcceptAdditions] {
            assert_eq!(MismatchPolicy::of_word(policy.word()), Some(policy));
        }
        assert_eq!(MismatchPolicy::of_word("ignore"), None);
    }
}
