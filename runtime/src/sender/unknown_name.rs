//! The error of a name that no application has.

use std::{
    error::Error,
    fmt,
    sync::{Arc, Weak},
};

use super::Directory;

/// No application has the name now.
///
/// It can say which names are similar. They are looked for when it is shown, not when the message is refused: so a loop that sends to a name
/// which is away pays nothing for them.
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
    /// Gone with the node.
    directory: Weak<dyn Directory>,
}

impl UnknownNameError {
    pub(super) fn new(name: &str, directory: &Arc<dyn Directory>) -> Self {
        Self { name: name.to_owned(), directory: Arc::downgrade(directory) }
    }

    /// The name that no application has.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Names of applications that are similar and there now, three at most, the most similar first. An application in a process of its own
    /// knows of none.
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

    struct Names;

    impl Directory for Names {
        fn resolve(&self, _: &str) -> Option<Tid> {
            None
        }

        fn nearest(&self, _: &str) -> Vec<String> {
            vec!["knee.drive".to_owned(), "hip.drive".to_owned()]
        }

        fn set_member(&self, _: AppAddress, _: AppAddress, _: bool) {}
    }

    #[test]
    fn it_shows_the_nearest_names_while_the_node_is_there() {
        let directory: Arc<dyn Directory> = Arc::new(Names);
        let error = UnknownNameError::new("knee.driev", &directory);
        let text = error.to_string();
        assert!(text.contains("'knee.driev' now; nearest: knee.drive, hip.drive; correct"), "{text}");
        drop(directory);
        assert!(error.to_string().contains("'knee.driev' now; correct"), "{error}");
    }
}
