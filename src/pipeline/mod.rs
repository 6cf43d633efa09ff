//! The only code that composes the stages; knows nothing of the web.
