//! Times as text, UTC, to the second.

/// Nanoseconds since 1970 as RFC 3339 writes them: `2026-07-30T12:00:00Z`.
pub fn rfc3339(unix_nanos: u64) -> String {
    let ([year, month, day], [hour, minute, second]) = civil(unix_nanos / 1_000_000_000);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z")
}

/// Seconds since 1970 as a name that files may have: `2026-07-30_12-00-00`.
pub(super) fn time_name(unix_seconds: u64) -> String {
    let ([year, month, day], [hour, minute, second]) = civil(unix_seconds);
    format!("{year:04}-{month:02}-{day:02}_{hour:02}-{minute:02}-{second:02}")
}

/// Date and time of seconds since 1970. Days to dates after H. Hinnant, chrono-Compatible Low-Level Date Algorithms.
fn civil(unix_seconds: u64) -> ([u64; 3], [u64; 3]) {
    let (days, second) = (unix_seconds / 86_400 + 719_468, unix_seconds % 86_400);
    let (era, day_of_era) = (days / 146_097, days % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month_index = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month_index + 2) / 5 + 1;
    let month = if month_index < 10 { month_index + 3 } else { month_index - 9 };
    let year = year_of_era + era * 400 + u64::from(month <= 2);
    ([year, month, day], [second / 3600, second / 60 % 60, second % 60])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_dates() {
        for (seconds, text) in [
            (0, "1970-01-01T00:00:00Z"),
            (951_782_399, "2000-02-28T23:59:59Z"),
            (951_782_400, "2000-02-29T00:00:00Z"),
            (1_700_000_000, "2023-11-14T22:13:20Z"),
            (4_107_542_400, "2100-03-01T00:00:00Z"),
        ] {
            assert_eq!(rfc3339(seconds * 1_000_000_000), text);
        }
        assert_eq!(time_name(951_827_696), "2000-02-29_12-34-56");
    }
}
