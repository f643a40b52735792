// A worker whose tasks are called as functions that return promises, and the worker's end of it.

/** What the page may say to the user, unlike errors of the program. */
export class UserError extends Error {}

export class Background {
  constructor(url) {
    this.calls = new Map();
    this.next = 0;
    this.worker = new Worker(url, { type: "module" });
    this.worker.onmessage = ({ data: { id, result, error } }) => {
      const call = this.calls.get(id);
      this.calls.delete(id);
      if (error === undefined) call.resolve(result);
      else call.reject(new Error(error));
    };
    this.worker.onerror = (event) => {
      event.preventDefault();
      for (const call of this.calls.values()) {
        call.reject(new Error("This browser is too old for the page: use a newer one."));
      }
      this.calls.clear();
    };
  }

  /** @param {string} task @param {object} values @returns {Promise<any>} */
  call(task, values, transfer = []) {
    const id = this.next++;
    return new Promise((resolve, reject) => {
      this.calls.set(id, { resolve, reject });
      this.worker.postMessage({ id, task, values }, transfer);
    });
  }
}

/**
 * Answers calls, in a worker.
 *
 * @param {Object<string, (values: any) => any>} tasks
 * @param {(reason: string) => string} explain the sentence for an error of the program
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
