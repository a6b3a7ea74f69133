//! The transfers of one plugged-in device: requests in, completions out.

use super::{ControlReply, MAX_TRANSFER_BYTES, Setup, Transmit, UsbDevice};
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Most transfers that may wait for a device's data at once.
pub const MAX_WAITING: usize = 1024;

/// What a host asks for. `id` is the host's name for the transfer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Request {
    /// A control transfer.
    Control {
        /// Transfer.
        id: u64,
        /// Its setup.
        setup: Setup,
        /// Data for the device.
        data: Vec<u8>,
    },
    /// Data for an endpoint.
    Out {
        /// Transfer.
        id: u64,
        /// Endpoint, 1..=15.
        endpoint: u8,
        /// The data.
        data: Vec<u8>,
    },
    /// Data wanted from an endpoint.
    In {
        /// Transfer.
        id: u64,
        /// Endpoint, 1..=15.
        endpoint: u8,
        /// Most bytes.
        max_bytes: u32,
    },
    /// A transfer of a kind that no device here has.
    Unsupported {
        /// Transfer.
        id: u64,
        /// Endpoint, 0..=15.
        endpoint: u8,
    },
    /// A waiting transfer is to be taken back.
    Cancel {
        /// This request.
        id: u64,
        /// The transfer.
        victim: u64,
    },
    /// The wire itself asks an interrupt endpoint, over and over, from now on or no longer.
    Poll {
        /// This request.
        id: u64,
        /// Endpoint, 1..=15.
        endpoint: u8,
        /// From now on.
        on: bool,
    },
    /// Everything is to be forgotten.
    Reset,
}

/// How a request ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// Control transfer to the device, or data taken: how many bytes.
    Taken(u32),
    /// Data for the host.
    Data(Vec<u8>),
    /// The endpoint has halted, or the request is refused.
    Stall,
    /// The transfer was taken back; of the request to do so: whether it was still waiting.
    Cancelled {
        /// The transfer.
        victim: u64,
        /// It had not been completed.
        was_waiting: bool,
    },
    /// Data of an endpoint that is polled.
    Polled(Vec<u8>),
    /// The polling was begun or ended.
    PollSet,
}

/// The end of a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Completion {
    /// The request.
    pub id: u64,
    /// Endpoint, 0..=15.
    pub endpoint: u8,
    /// How it ended.
    pub outcome: Outcome,
}

/// The host asks for more at once than any driver does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("more than {MAX_WAITING} transfers wait for data; the host must take some back")]
pub struct TooManyWaiting;

/// Waiting transfers of one device.
#[derive(Debug, Default)]
pub struct Bus {
    waiting: BTreeMap<u8, VecDeque<(u64, u32)>>,
    waiting_count: usize,
    polled: BTreeSet<u8>,
}

impl Bus {
    /// Handles one request; what it completes is appended to `done`.
    ///
    /// # Errors
    /// [`TooManyWaiting`]; the connection is to be closed.
    pub fn handle(
        &mut self,
        request: Request,
        device: &mut dyn UsbDevice,
        done: &mut Vec<Completion>,
    ) -> Result<(), TooManyWaiting> {
        let mut end = |id, endpoint, outcome| done.push(Completion { id, endpoint, outcome });
        match request {
            Request::Control { id, setup, data } => end(id, 0, control(device, &setup, &data)),
            Request::Out { id, endpoint, data } => {
                let is_taken = device.receive(endpoint, &data);
                end(id, endpoint, if is_taken { Outcome::Taken(data.len() as u32) } else { Outcome::Stall });
            }
            Request::In { id, endpoint, max_bytes } => {
                if self.waiting_count >= MAX_WAITING {
                    return Err(TooManyWaiting);
                }
                self.waiting.entry(endpoint).or_default().push_back((id, max_bytes.min(MAX_TRANSFER_BYTES)));
                self.waiting_count += 1;
            }
            Request::Unsupported { id, endpoint } => end(id, endpoint, Outcome::Stall),
            Request::Cancel { id, victim } => {
                let endpoint = self.cancel(victim);
                let outcome = Outcome::Cancelled { victim, was_waiting: endpoint.is_some() };
                end(id, endpoint.unwrap_or(0), outcome);
            }
            Request::Poll { id, endpoint, on } => {
                if on {
                    self.polled.insert(endpoint);
                } else {
                    self.polled.remove(&endpoint);
                }
                end(id, endpoint, Outcome::PollSet);
            }
            Request::Reset => {
                *self = Self::default();
                device.reset();
            }
        }
        Ok(())
    }

    /// Transfers that wait for data.
    pub fn waiting_count(&self) -> usize {
        self.waiting_count
    }

    fn cancel(&mut self, victim: u64) -> Option<u8> {
        for (&endpoint, queue) in &mut self.waiting {
            if let Some(i) = queue.iter().position(|w| w.0 == victim) {
                queue.remove(i);
                self.waiting_count -= 1;
                return Some(endpoint);
            }
        }
        None
    }

    /// Completes waiting transfers that the device has data for, until `budget_bytes` have been moved.
    pub fn pump(&mut self, device: &mut dyn UsbDevice, budget_bytes: usize, done: &mut Vec<Completion>) {
        let mut moved = 0;
        for (&endpoint, queue) in &mut self.waiting {
            while let (Some(&(id, max_bytes)), true) = (queue.front(), moved < budget_bytes) {
                let outcome = match device.transmit(endpoint, max_bytes as usize) {
                    Transmit::Nothing => break,
                    Transmit::Data(mut bytes) => {
                        bytes.truncate(max_bytes as usize);
                        moved += bytes.len().max(1);
                        Outcome::Data(bytes)
                    }
                    Transmit::Stall => Outcome::Stall,
                };
                queue.pop_front();
                self.waiting_count -= 1;
                done.push(Completion { id, endpoint, outcome });
            }
        }
        for &endpoint in &self.polled {
            let address = endpoint | 0x80;
            let found = device.descriptors().endpoints().into_iter().find(|e| e.address == address);
            let packet_bytes = found.map_or(0, |e| usize::from(e.packet_bytes));
            while moved < budget_bytes {
                let Transmit::Data(bytes) = device.transmit(endpoint, packet_bytes) else { break };
                moved += bytes.len().max(1);
                done.push(Completion { id: 0, endpoint, outcome: Outcome::Polled(bytes) });
            }
        }
    }
}

fn control(device: &mut dyn UsbDevice, setup: &Setup, data: &[u8]) -> Outcome {
    match device.control(setup, data) {
        ControlReply::Data(mut bytes) => {
            bytes.truncate(usize::from(setup.length));
            Outcome::Data(bytes)
        }
        ControlReply::Done => Outcome::Taken(data.len() as u32),
        ControlReply::Stall => Outcome::Stall,
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::usb_device::descriptor::tests::example;
    use crate::usb_device::{Descriptors, Speed};

    /// Sends back on endpoint 1 what it gets there; counts resets.
    pub(crate) struct Loop {
        descriptors: Descriptors,
        pub stored: VecDeque<Vec<u8>>,
        pub resets: usize,
    }

    impl Loop {
        pub(crate) fn new() -> Self {
            Self { descriptors: example(Speed::High), stored: VecDeque::new(), resets: 0 }
        }
    }

    impl UsbDevice for Loop {
        fn descriptors(&self) -> &Descriptors {
            &self.descriptors
        }
        fn control(&mut self, setup: &Setup, _: &[u8]) -> ControlReply {
            if let Some(reply) = self.descriptors.answer(setup) {
                reply
            } else if setup.is_in() {
                ControlReply::Data(vec![0x5a; 300])
            } else {
                ControlReply::Done
            }
        }
        fn receive(&mut self, endpoint: u8, data: &[u8]) -> bool {
            // A device bounds what it stores.
            if self.stored.len() < 64 {
                self.stored.push_back(data.to_vec());
            }
            endpoint == 1
        }
        fn transmit(&mut self, endpoint: u8, max_bytes: usize) -> Transmit {
            if endpoint == 3 {
                return Transmit::Stall;
            }
            self.stored.pop_front().map_or(Transmit::Nothing, |mut d| {
                d.truncate(max_bytes);
                Transmit::Data(d)
            })
        }
        fn reset(&mut self) {
            self.resets += 1;
        }
    }

    fn done_by(bus: &mut Bus, device: &mut Loop, requests: Vec<Request>) -> Vec<Completion> {
        let mut done = Vec::new();
        for request in requests {
            bus.handle(request, device, &mut done).unwrap();
        }
        bus.pump(device, 1 << 20, &mut done);
        done
    }

    #[test]
    fn transfers_wait_for_data_in_their_order() {
        let (mut bus, mut device) = (Bus::default(), Loop::new());
        let ask = |id| Request::In { id, endpoint: 1, max_bytes: 4 };
        assert!(done_by(&mut bus, &mut device, vec![ask(1), ask(2)]).is_empty());
        let out = |id, byte| Request::Out { id, endpoint: 1, data: vec![byte; 3] };
        let end = |id, outcome| Completion { id, endpoint: 1, outcome };
        let done = done_by(&mut bus, &mut device, vec![out(3, 7), out(4, 8)]);
        let expected = [
            end(3, Outcome::Taken(3)),
            end(4, Outcome::Taken(3)),
            end(1, Outcome::Data(vec![7; 3])),
            end(2, Outcome::Data(vec![8; 3])),
        ];
        assert_eq!(done, expected);
    }

    #[test]
    fn a_cancelled_transfer_is_never_completed() {
        let (mut bus, mut device) = (Bus::default(), Loop::new());
        let ask = Request::In { id: 1, endpoint: 1, max_bytes: 4 };
        let done = done_by(&mut bus, &mut device, vec![ask, Request::Cancel { id: 2, victim: 1 }]);
        let outcome = Outcome::Cancelled { victim: 1, was_waiting: true };
        assert_eq!(done, [Completion { id: 2, endpoint: 1, outcome }]);
        let again = [Request::Cancel { id: 3, victim: 1 }, Request::Out { id: 4, endpoint: 1, data: vec![1] }];
        let done = done_by(&mut bus, &mut device, again.to_vec());
        assert_eq!(done[0].outcome, Outcome::Cancelled { victim: 1, was_waiting: false });
        assert_eq!(done.len(), 2);
    }

    #[test]
    fn halts_polling_and_reset() {
        let (mut bus, mut device) = (Bus::default(), Loop::new());
        let done = done_by(&mut bus, &mut device, vec![Request::In { id: 1, endpoint: 3, max_bytes: 4 }]);
        assert_eq!(done, [Completion { id: 1, endpoint: 3, outcome: Outcome::Stall }]);
        device.stored.push_back(vec![9; 40]);
        let done = done_by(&mut bus, &mut device, vec![Request::Poll { id: 2, endpoint: 2, on: true }]);
        assert_eq!(done[1], Completion { id: 0, endpoint: 2, outcome: Outcome::Polled(vec![9; 16]) });
        assert!(done_by(&mut bus, &mut device, vec![Request::Reset]).is_empty());
        device.stored.push_back(vec![9]);
        assert!(done_by(&mut bus, &mut device, vec![]).is_empty());
        assert_eq!(device.resets, 1);
    }

    #[test]
    fn control_data_is_cut_to_what_was_asked_for() {
        let (mut bus, mut device) = (Bus::default(), Loop::new());
        let setup = Setup { request_type: 0xc0, request: 9, value: 0, index: 0, length: 5 };
        let done = done_by(&mut bus, &mut device, vec![Request::Control { id: 1, setup, data: vec![] }]);
        assert_eq!(done[0].outcome, Outcome::Data(vec![0x5a; 5]));
    }

    #[test]
    fn waiting_transfers_are_bounded() {
        let (mut bus, mut device, mut done) = (Bus::default(), Loop::new(), Vec::new());
        let mut ask = |id| bus.handle(Request::In { id, endpoint: 2, max_bytes: u32::MAX }, &mut device, &mut done);
        assert!((0..MAX_WAITING as u64).all(|id| ask(id).is_ok()));
        assert_eq!(ask(5000), Err(TooManyWaiting));
    }
}
