//! The error for a name that no application has.

use std::{
    error::Error,
    fmt,
    sync::{Arc, Weak},
};

use super::Directory;

/// No application has the name now.
///
/// The error can list similar names. They are searched when the error is displayed, not when the message is
/// rejected. So a loop that sends to an absent name has no cost for the search.
///
/// # Examples
///
/// ```
/// use sinew::message::SendError;
///
/// fn explain(error: &SendError) {
///     if let SendError::UnknownName(unknown) = error {
///         eprintln!("'{}' is not there; did you mean {:?}?", unknown.name(), unknown.nearest());
///     }
/// }
/// ```
#[derive(Clone)]
pub struct UnknownNameError {
    name: String,
    /// Dropped with the node.
    directory: Weak<dyn Directory>,
}

impl UnknownNameError {
    pub(super) fn new(name: &str, directory: &Arc<dyn Directory>) -> Self {
        Self { name: name.to_owned(), directory: Arc::downgrade(directory) }
    }

    /// Returns the name that no application has.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns similar names of present applications, three at most, the most similar first. An application
    /// in a process of its own gets none.
    #[must_use]
    pub fn nearest(&self) -> Vec<String> {
        self.directory.upgrade().map_or_else(Vec::new, |directory| directory.nearest(&self.name))
    }
}

impl PartialEq for UnknownNameError {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name
    }
}

impl Eq for UnknownNameError {}

impl fmt::Debug for UnknownNameError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("UnknownNameError").field(&self.name).finish()
    }
}

impl fmt::Display for UnknownNameError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let directory = self.directory.upgrade();
        if let Some(why) = directory.and_then(|directory| directory.why_not(&self.name)) {
            return write!(f, "'{}' is required, and is not there now: {why}", self.name);
        }
        write!(f, "no application is called '{}' now; ", self.name)?;
        match &*self.nearest() {
            [] => {}
            nearest => write!(f, "nearest: {}; ", nearest.join(", "))?,
        }
        f.write_str("correct the name, or require it, so that this application starts when it is there")
    }
}

impl Error for UnknownNameError {}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tid::{AppAddress, Tid};

    /// The directory of a node with an application that requires `ankle`; the node of `ankle` is lost.
    struct Names;

    impl Directory for Names {
        fn why_not(&self, name: &str) -> Option<String> {
            (name == "ankle").then(|| "its node was lost (2.0 s ago)".to_owned())
        }

        fn resolve(&self, _: &str) -> Option<Tid> {
            None
        }

        fn nearest(&self, _: &str) -> Vec<String> {
            vec!["knee.drive".to_owned(), "hip.drive".to_owned()]
        }

        fn set_member(&self, _: AppAddress, _: AppAddress, _: bool) {}
    }

    #[test]
    fn nearest_names_are_shown_while_the_node_is_there() {
        let directory: Arc<dyn Directory> = Arc::new(Names);
        let error = UnknownNameError::new("knee.driev", &directory);
        let text = error.to_string();
        assert!(text.contains("'knee.driev' now; nearest: knee.drive, hip.drive; correct"), "{text}");
        drop(directory);
        assert!(error.to_string().contains("'knee.driev' now; correct"), "{error}");
    }

    #[test]
    fn required_name_has_its_reason_and_no_other_names() {
        let directory: Arc<dyn Directory> = Arc::new(Names);
        let text = UnknownNameError::new("ankle", &directory).to_string();
        assert_eq!(text, "'ankle' is required, and is not there now: its node was lost (2.0 s ago)");
    }
}
