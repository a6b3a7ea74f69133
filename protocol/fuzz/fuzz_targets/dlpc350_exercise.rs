// What the fuzz target does with its bytes; `tests/dlpc350.rs` runs the same on the corpus.

use gv3_protocol::dlpc350::*;

/// Bytes as reports of the projector and as reports of the host: whatever is understood reads back from its own bytes.
pub fn reports(bytes: &[u8]) {
    let mut requests = RequestAssembler::default();
    for report in bytes.chunks(REPORT_BYTES) {
        if let Ok(reply) = Reply::parse(report) {
            assert!(reply.data.len() <= MAX_REPLY_BYTES && Reply::parse(&reply.encode()).as_ref() == Ok(&reply));
            registers(&reply.data);
        }
        let Ok(report) = Report::try_from(report) else { continue };
        if let Ok(Some(request)) = requests.push(&report) {
            registers(&request.payload);
            let mut again = RequestAssembler::default();
            let reports = request.reports().expect("what was taken apart fits together");
            let last = reports.iter().map(|r| again.push(r)).last();
            assert_eq!(last, Some(Ok(Some(request))));
        }
    }
}

fn registers(data: &[u8]) {
    register::<HardwareStatus>(data);
    register::<SystemStatus>(data);
    register::<MainStatus>(data);
    register::<Validation>(data);
    register::<Version>(data);
    register::<FirmwareTag>(data);
    register::<FlashImageCount>(data);
    register::<Power>(data);
    register::<InputSource>(data);
    register::<DisplayMode>(data);
    register::<PatternSource>(data);
    register::<Playback>(data);
    register::<TriggerMode>(data);
    register::<Mailbox>(data);
    register::<MailboxOffset>(data);
    register::<ExposurePeriod>(data);
    register::<LutControl>(data);
    register::<PatternLut>(data);
    register::<ImageLut>(data);
    register::<TriggerOut1>(data);
    register::<TriggerOut2>(data);
    register::<LedEnable>(data);
    register::<LedCurrent>(data);
}

fn register<R: Register + PartialEq + std::fmt::Debug>(data: &[u8]) {
    match R::decode(data) {
        Ok(value) => assert_eq!(R::decode(&value.encode()).as_ref(), Ok(&value)),
        Err(error) => assert!(error.to_string().starts_with(R::NAME), "{error}"),
    }
}
