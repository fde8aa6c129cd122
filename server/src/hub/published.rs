//! What the machine publishes, events, and virtual time.

use super::*;

impl Hub {
    /// Publishes the machine's present state.
    pub fn publish(&self, latest: Latest) {
        self.lock().latest = Some(Arc::new(latest));
    }

    #[must_use]
    pub fn latest(&self) -> Option<Arc<Latest>> {
        self.lock().latest.clone()
    }

    /// Sets the ring of the run, with cable redundancy.
    pub fn set_ring(&self, ring: &'static RingStatus) {
        self.lock().ring = Some(ring);
    }

    /// Returns the ring of the run, with cable redundancy.
    #[must_use]
    pub fn ring(&self) -> Option<&'static RingStatus> {
        self.lock().ring
    }

    pub fn set_places(&self, places: IndexVec<DeviceIndex, DevicePlace>) {
        self.lock().places = places;
    }

    #[must_use]
    pub fn places(&self) -> IndexVec<DeviceIndex, DevicePlace> {
        self.lock().places.clone()
    }

    pub fn set_mailboxes(&self, mailboxes: Mailboxes) {
        self.lock().mailboxes = Some(mailboxes);
    }

    /// Returns access to the mailboxes of the devices.
    ///
    /// # Errors
    /// Fails if the bus is not up.
    pub fn mailboxes(&self) -> Result<Mailboxes, OpError> {
        self.lock().mailboxes.clone().ok_or_else(|| {
            OpError::new(ErrorCode::NotUp, "the bus is not up")
                .help("wait for it with `await`, or bring it up with `bus`")
        })
    }

    pub fn set_step(&self, step: RunningStep) {
        self.lock().step = step;
    }

    #[must_use]
    pub fn step(&self) -> RunningStep {
        self.lock().step.clone()
    }

    /// Remembers the value of an output; `None`: no client has set it, or its device was lost.
    pub fn set_output(&self, index: usize, value: Option<f64>) {
        if let Some(output) = self.lock().outputs.get_mut(index) {
            *output = value;
        }
    }

    /// Returns the values of the outputs that clients have set.
    #[must_use]
    pub fn output_values(&self) -> Vec<Option<f64>> {
        self.lock().outputs.clone()
    }

    /// Returns the owner of the motion and the rest of its time in ms.
    #[must_use]
    pub fn owner(&self) -> Option<(Owner, Option<u64>)> {
        let inner = self.lock();
        let (owner, rest) = inner.lease.holder(Instant::now())?;
        let rest = rest.map(|rest| u64::try_from(rest.as_millis()).unwrap_or(u64::MAX));
        Some((owner.clone(), rest))
    }

    // Events.

    /// Reports an event; `body` is an object.
    pub fn event(&self, body: Value) {
        self.push_event(&mut self.lock(), body);
    }

    pub(super) fn push_event(&self, inner: &mut Inner, body: Value) {
        let Value::Object(mut body) = body else {
            return;
        };
        let kind = body.get("event").and_then(Value::as_str);
        count(inner, Count::Event, kind.unwrap_or_default());
        let number = inner.next_event;
        inner.next_event += 1;
        let time = match self.options.virtual_time {
            true => inner.now,
            false => clock::now(),
        };
        body.insert("number".to_owned(), json!(number));
        body.insert("time_ns".to_owned(), json!(time));
        let event = Arc::new(Event { number, body });
        inner.events.push_back(Arc::clone(&event));
        if inner.events.len() > EVENTS {
            drop_one(&mut inner.events);
        }
        // Without a subscriber, the event is only kept.
        let _ = self.events.send(event);
    }

    /// Counts something of a device, an axis or a group.
    pub fn count(&self, what: Count, name: &str) {
        count(&mut self.lock(), what, name);
    }

    #[must_use]
    pub fn counts(&self) -> Counts {
        self.lock().counts.clone()
    }

    /// Keeps the fault report of a run, and reports it.
    pub fn keep_fault_report(&self, report: &FaultReport) {
        let text = json!(report);
        let mut inner = self.lock();
        let body = json!({"event": "fault_report", "headline": report.headline});
        let event = inner.next_event;
        self.push_event(&mut inner, body);
        let kept = json!({"event": event, "report": text});
        inner.fault_reports.push_back(kept.into());
        if inner.fault_reports.len() > FAULT_REPORTS {
            inner.fault_reports.pop_front();
        }
    }

    /// Returns the kept fault reports, each with the number of its event. They are large: commands wait
    /// for no copy.
    #[must_use]
    pub fn fault_reports(&self) -> Vec<Arc<Value>> {
        self.lock().fault_reports.iter().cloned().collect()
    }

    /// Returns the kept events with a number above `after`.
    #[must_use]
    pub fn events_after(&self, after: u64) -> Vec<Arc<Event>> {
        let inner = self.lock();
        let later = inner.events.iter().filter(|event| event.number > after);
        later.cloned().collect()
    }

    /// Returns the number of the last event.
    #[must_use]
    pub fn last_event(&self) -> u64 {
        self.lock().next_event - 1
    }

    /// Returns a receiver of all events from now on.
    #[must_use]
    pub fn subscribe(&self) -> broadcast::Receiver<Arc<Event>> {
        self.events.subscribe()
    }

    // Virtual time.

    /// Blocks while virtual time must stand: no client has asked for more, and none waits for an
    /// outcome.
    pub fn hold_virtual_time(&self, now: Nanos) {
        let mut inner = self.lock();
        inner.now = now;
        self.time.send_replace(now);
        while !inner.pending.values().any(PendingCommand::is_awaited)
            && inner.now >= inner.advance_to
            && !inner.shutdown
            && inner.wanted_up
        {
            inner = self
                .work
                .wait(inner)
                .unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Lets virtual time advance by `time`. Returns the time at its end.
    pub fn advance(&self, time: Nanos) -> Nanos {
        let mut inner = self.lock();
        inner.advance_to = inner.now.max(inner.advance_to).saturating_add(time);
        self.work.notify_all();
        inner.advance_to
    }

    /// Returns the virtual time as it advances.
    #[must_use]
    pub fn virtual_time(&self) -> watch::Receiver<Nanos> {
        self.time.subscribe()
    }

    /// Returns the time of the run's clock.
    #[must_use]
    pub fn now(&self) -> Nanos {
        match self.options.virtual_time {
            true => self.lock().now,
            false => clock::now(),
        }
    }
}

/// Drops the oldest event of the kind that has the most, so that frequent events do not replace the
/// rare ones.
fn drop_one(events: &mut VecDeque<Arc<Event>>) {
    let mut kinds: HashMap<&str, (usize, usize)> = HashMap::new();
    for (index, event) in events.iter().enumerate() {
        let kind = event.body.get("event").and_then(Value::as_str);
        let (count, _) = kinds.entry(kind.unwrap_or_default()).or_insert((0, index));
        *count += 1;
    }
    let most = kinds.into_values().max_by_key(|(count, _)| *count);
    if let Some((_, oldest)) = most {
        events.remove(oldest);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frequent_events_do_not_replace_rare_ones() {
        let event = |number: u64, kind: &str| {
            let Value::Object(body) = json!({"event": kind, "number": number}) else {
                unreachable!("an object");
            };
            Arc::new(Event { number, body })
        };
        let mut events: VecDeque<_> = [event(1, "fault"), event(2, "lease")].into();
        for number in 3..100 {
            events.push_back(event(
                number,
                if number % 2 == 0 { "area" } else { "client" },
            ));
            if events.len() > 10 {
                drop_one(&mut events);
            }
        }
        let kept: Vec<_> = events.iter().map(|event| event.number).collect();
        assert_eq!(kept, [1, 2, 92, 93, 94, 95, 96, 97, 98, 99]);
    }
}
