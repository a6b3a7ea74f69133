//! What crosses a cable or a file boundary: the session container.
#![forbid(unsafe_code)]
