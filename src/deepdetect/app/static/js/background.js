// Workers: tasks are called like functions that return promises, and answered in the worker.

/** An error with a sentence for the user, unlike errors of the program. */
export class UserError extends Error {}

export class Background {
  constructor(url) {
    this.calls = new Map();
    this.next = 0;
    this.hasAnswered = false;
    this.failure = null; // the error if the worker could not start
    this.worker = new Worker(url, { type: "module" });
    this.worker.onmessage = ({ data: { id, result, error } }) => {
      this.hasAnswered = true;
      const call = this.calls.get(id);
      this.calls.delete(id);
      if (error === undefined) call.resolve(result);
      else call.reject(new Error(error));
    };
    this.worker.onerror = (event) => {
      event.preventDefault();
      const error = new Error(this.explain(event.message));
      if (!this.hasAnswered) this.failure = error;
      for (const call of this.calls.values()) call.reject(error);
      this.calls.clear();
    };
  }

  /** Returns a sentence for an uncaught error; without a message, a file could not be loaded. */
  explain(message) {
    if (this.hasAnswered) return `The page has failed (${message}): load it again.`;
    return message ? "This browser is too old for the page: use a newer one."
                   : "A part of the page could not be loaded: load it again.";
  }

  /** @param {string} task @param {object} values @returns {Promise<any>} */
  call(task, values, transfer = []) {
    if (this.failure) return Promise.reject(this.failure);
    const id = this.next++;
    return new Promise((resolve, reject) => {
      this.calls.set(id, { resolve, reject });
      this.worker.postMessage({ id, task, values }, transfer);
    });
  }
}

/** A worker that runs one task after the other; each can be cancelled, also while it runs. */
export class CancellableBackground {
  constructor(url) {
    this.url = url;
    this.waiting = [];
    this.running = null;
    this.background = new Background(url);
  }

  /**
   * @param {string} task @param {object} values
   * @param {AbortSignal} [signal] cancels the task: the promise is rejected with the signal's reason
   * @returns {Promise<any>}
   */
  call(task, values, signal) {
    return new Promise((resolve, reject) => {
      signal?.throwIfAborted();
      const call = { task, values, resolve, reject };
      signal?.addEventListener("abort", () => this.cancel(call, signal.reason), { once: true });
      this.waiting.push(call);
      this.runNext();
    });
  }

  async runNext() {
    if (this.running || !this.waiting.length) return;
    const call = this.running = this.waiting.shift();
    await this.background.call(call.task, call.values).then(call.resolve, call.reject);
    this.running = null;
    this.runNext();
  }

  cancel(call, reason) {
    call.reject(reason);
    this.waiting = this.waiting.filter((other) => other !== call);
    if (this.running !== call) return;
    this.background.worker.terminate(); // a busy worker receives no messages
    this.background = new Background(this.url);
    this.running = null;
    this.runNext();
  }
}

/**
 * Answers calls inside a worker.
 *
 * @param {Object<string, (values: any) => any>} tasks
 * @param {(reason: string) => string} explain returns the sentence for an error of the program
 */
export function answer(tasks, explain) {
  self.onmessage = async ({ data: { id, task, values } }) => {
    try {
      self.postMessage({ id, result: await tasks[task](values) });
    } catch (error) {
      const said = error instanceof UserError ? error.message : explain(error.message);
      self.postMessage({ id, error: said });
    }
  };
}
