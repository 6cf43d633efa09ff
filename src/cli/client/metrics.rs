//! Figures from what a server answers at `/metrics`.

/// The server's resident memory in bytes.
pub(in crate::cli) fn resident_bytes(metrics: &str) -> Option<u64> {
    let line = metrics
        .lines()
        .find(|line| line.starts_with("process_resident_memory_bytes "))?;
    let value: f64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(value as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resident_memory_is_read_from_the_exposition_format() {
        let text =
            "# TYPE process_resident_memory_bytes gauge\nprocess_resident_memory_bytes 123456789\n";
        assert_eq!(resident_bytes(text), Some(123_456_789));
        assert_eq!(resident_bytes("something_else 1\n"), None);
    }
}
